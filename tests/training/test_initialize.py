"""Starting Gaussians against a brute-force neighbour search and the definition of their box."""

import dataclasses

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.config import InitConfig
from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.scene import Scene, View
from clsplat.training.initialize import VARIANCE_SHARE, from_points, initialize, random

RNG = np.random.default_rng(7)


def orbit(count=12, target=(1.0, 2.0, 3.0), distance=4.0):
    angles = np.arange(count) * 2 * np.pi / count
    eyes = np.asarray(target) + distance * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    return [Camera.look_at(eye, target, (0, 0, 1), 100, 64, 48) for eye in eyes]


def brute_force_scales(points):
    squared = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    np.fill_diagonal(squared, np.inf)
    return np.sqrt(np.sort(squared, axis=1)[:, :3].mean(axis=1))


def test_scales_are_the_rms_distance_to_three_neighbours():
    points = RNG.normal(size=(50, 3))
    gaussians = from_points(points, np.zeros((50, 3), np.uint8), InitConfig()).validate()
    expected = brute_force_scales(points)
    # float32 stores the logarithm to 2^-24 of its size, here at most about 2
    np.testing.assert_allclose(gaussians.scales, np.repeat(expected[:, None], 3, axis=1), rtol=1e-6)
    np.testing.assert_array_equal(gaussians.means, points.astype(np.float32))
    np.testing.assert_array_equal(gaussians.quats, np.tile(np.float32([1, 0, 0, 0]), (50, 1)))
    assert all(array.dtype == np.float32 for array in gaussians.arrays().values())


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colour_and_opacity_come_back(degree):
    colors = RNG.integers(0, 256, (20, 3)).astype(np.uint8)
    config = InitConfig(opacity=0.3, sh_degree=degree)
    gaussians = from_points(RNG.normal(size=(20, 3)), colors, config)
    assert gaussians.sh.shape == (20, (degree + 1) ** 2, 3)
    np.testing.assert_allclose(0.5 + SH_C0 * gaussians.sh[:, 0], colors / 255, atol=1e-6)  # float32 of values to 2
    assert not gaussians.sh[:, 1:].any()
    np.testing.assert_allclose(gaussians.opacities, 0.3, rtol=1e-6)


def test_duplicates_get_the_smallest_scale_and_stay_finite():
    points = np.concatenate([np.zeros((5, 3)), RNG.normal(size=(5, 3))])
    gaussians = from_points(points, np.zeros((10, 3), np.uint8), InitConfig())
    apart = np.sort(np.linalg.norm(points[5:, None] - points, axis=2), axis=1)[:, 1:4]
    smallest = np.sqrt(VARIANCE_SHARE * np.median(np.mean(apart**2, axis=1)))
    np.testing.assert_allclose(gaussians.scales[:5], smallest, rtol=1e-6)
    assert np.isfinite(gaussians.log_scales).all()


def test_fewer_neighbours_than_three():
    two = from_points([[0, 0, 0], [0, 0, 2]], np.zeros((2, 3), np.uint8), InitConfig())
    np.testing.assert_allclose(two.scales, 2)
    three = from_points([[0, 0, 0], [0, 0, 2], [0, 0, -4]], np.zeros((3, 3), np.uint8), InitConfig())
    np.testing.assert_allclose(three.scales[0], np.sqrt((4 + 16) / 2), rtol=1e-6)
    one = from_points([[5, 6, 7]], np.zeros((1, 3), np.uint8), InitConfig())
    np.testing.assert_allclose(one.scales, 1)


@pytest.mark.parametrize(
    ("points", "colors", "name"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "points"),
        (np.full((2, 3), np.nan), np.zeros((2, 3), np.uint8), "points"),
        (np.zeros((2, 2)), np.zeros((2, 2), np.uint8), "points"),
        (np.zeros((2, 3)), np.zeros((3, 3), np.uint8), "colors"),
        (np.zeros((2, 3)), np.zeros((2, 3)), "colors"),
    ],
)
def test_bad_points_are_refused(points, colors, name):
    with pytest.raises(InputError, match=name):
        from_points(points, colors, InitConfig())


@pytest.mark.parametrize(
    "change",
    [{"opacity": 0.0}, {"opacity": 1.0}, {"random_points": 0}, {"random_extent": -1.0}, {"random_extent": np.nan}],
)
def test_bad_options_are_refused(change):
    with pytest.raises(InputError, match="--init." + next(iter(change)).replace("_", "-")):
        random(orbit(), InitConfig(**change), 0)


def test_random_fills_the_box_around_the_focus():
    config = InitConfig(random_points=2000, random_extent=0.5)
    gaussians = random(orbit(), config, 3).validate()
    assert len(gaussians) == 2000
    centred = gaussians.means - np.float32([1, 2, 3])
    assert np.abs(centred).max() <= 2 * (1 + 1e-6)
    # Of 2000 uniform values the largest falls short of the edge by 2 % with probability 1e-17, and the mean
    # strays from 0 by 0.13 (5 of its standard deviations 2/sqrt(3*2000)) hardly ever.
    assert (np.abs(centred).max(axis=0) > 1.96).all()
    assert np.abs(centred.mean(axis=0)).max() < 0.13
    rgb = 0.5 + SH_C0 * gaussians.sh[:, 0]
    assert rgb.min() >= -1e-6 and rgb.max() <= 1 + 1e-6 and rgb.std() > 0.25


def test_random_repeats_under_a_seed_only():
    config = InitConfig(random_points=100)
    first, again, other = (random(orbit(), config, seed) for seed in (1, 1, 2))
    for name, array in first.arrays().items():
        np.testing.assert_array_equal(array, again.arrays()[name])
    assert not np.array_equal(first.means, other.means)


@pytest.mark.parametrize(
    "cameras", [orbit(1), [c.translated(np.array([0.0, 0, k])) for k in range(4) for c in orbit(1)]]
)
def test_random_without_a_focus_is_in_front_of_the_cameras(cameras):
    gaussians = random(cameras, InitConfig(random_points=500), 0)
    assert np.isfinite(gaussians.means).all() and gaussians.means.std() > 0
    for camera in cameras:
        depths = gaussians.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        assert (depths > 0).mean() > 0.5


def test_initialize_takes_points_where_there_are_any():
    camera = orbit(1)[0]
    view = View("a.png", camera, np.zeros((48, 64, 3), np.uint8))
    scene = Scene([view], [], np.array([[0.0, 0, 0], [1, 1, 1]]), np.zeros((2, 3), np.uint8))
    config = InitConfig(random_points=10)
    assert len(initialize(scene, config, 0)) == 2
    bare = dataclasses.replace(scene, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    assert len(initialize(bare, config, 0)) == 10


def test_a_cap_thins_the_start():
    """Points are drawn, in proportion wherever they lie, and sized by their neighbours among those drawn."""
    points, colors = RNG.normal(size=(400, 3)), RNG.integers(0, 256, (400, 3)).astype(np.uint8)
    scene = Scene([View("a.png", orbit(1)[0], np.zeros((48, 64, 3), np.uint8))], [], points, colors)
    found = initialize(scene, InitConfig(), 3, 100)
    rows = [int(np.flatnonzero((points.astype(np.float32) == mean).all(axis=1))[0]) for mean in found.means]
    assert len(set(rows)) == 100 and rows == sorted(rows)
    # Of the first half of the rows 50 on average, by 4.3 in the standard deviation.
    assert abs(np.sum(np.array(rows) < 200) - 50) < 20
    np.testing.assert_allclose(found.scales[:, 0], brute_force_scales(points[rows]), rtol=1e-5)
    np.testing.assert_allclose(found.sh[:, 0] * SH_C0 + 0.5, colors[rows] / 255, atol=1e-6)
    assert (initialize(scene, InitConfig(), 3, 100).means == found.means).all()
    assert not (initialize(scene, InitConfig(), 4, 100).means == found.means).all()
    assert len(initialize(scene, InitConfig(), 3, 400)) == 400
    bare = dataclasses.replace(scene, points=points[:0], colors=colors[:0])
    assert len(initialize(bare, InitConfig(random_points=50), 0, 20)) == 20
