"""Dense points of a textured wall, whose photos are computed by the intersection of rays with it."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.config import InitConfig, TrainConfig
from clsplat.device import Device
from clsplat.renderer import Renderer
from clsplat.scene import Scene, View
from clsplat.training.autosize import rule
from clsplat.training.dense_start import (
    BYTES,
    Depths,
    agreed,
    first_points,
    neighbours,
    thinned,
    with_dense_points,
)
from clsplat.training.loop import train

WALL = 4.0
"""Depth of the wall, which the plane z = WALL is."""


def wall_color(x, y):
    """Waves of several lengths, the shortest some pixels long; RGB in [0, 1]."""
    rng = np.random.default_rng(0)
    waves = sum(np.cos(x * a + y * b + c) for a, b, c in rng.uniform(-12, 12, (24, 3)))
    return np.clip(0.5 + 0.1 * np.stack([waves, -waves, waves], axis=-1), 0, 1)


def photo(camera, gain=1.0):
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = rays @ camera.viewmat[:3, :3]
    hits = camera.position + rays * ((WALL - camera.position[2]) / rays[:, :, 2])[:, :, None]
    return np.rint(255 * gain * wall_color(hits[:, :, 0], hits[:, :, 1])).astype(np.uint8)


def wall(count=4, gains=None):
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-2, 2, (60, 2)), np.full(60, WALL)])
    cameras = [
        Camera.look_at((0.5 * k - 0.75, 0.1 * k, 0), (0, 0, WALL), (0, -1, 0), 60, 64, 48) for k in range(count)
    ]
    gains = gains or [1.0] * count
    views = [View(f"{k}.png", camera, photo(camera, gains[k])) for k, camera in enumerate(cameras)]
    return Scene(views, [], points, np.zeros((60, 3), np.uint8))


def dense(scene, device, most=1000):
    return with_dense_points(scene, Renderer(device), most, 0)


@pytest.mark.parametrize("gains", [None, [1.0, 0.7, 0.9, 0.8]], ids=["one exposure", "several"])
def test_points_lie_on_the_wall(device: Device, gains) -> None:
    scene = wall(gains=gains)
    found = dense(scene, device)
    added, colors = found.points[60:], found.colors[60:]
    assert len(added) > 500
    # A plane shifts photos by half a pixel or less, about 1 % of the depth.
    assert np.median(np.abs(added[:, 2] - WALL)) < 0.01 * WALL
    assert np.quantile(np.abs(added[:, 2] - WALL), 0.99) < 0.03 * WALL
    if gains is None:
        expected = 255 * wall_color(added[:, 0], added[:, 1])
        assert np.median(np.abs(colors - expected)) < 12  # a level of texture across half a pixel
    np.testing.assert_array_equal(found.points[:60], scene.points)


def test_repeats_to_the_bit_and_keeps_to_the_number(device: Device) -> None:
    scene = wall()
    first, second = dense(scene, device, 300), dense(scene, device, 300)
    np.testing.assert_array_equal(first.points, second.points)
    assert 200 < len(first.points) <= 300
    assert dense(scene, device, 60) is scene


def test_masked_pixels_add_no_points(device: Device) -> None:
    scene = wall()
    mask = np.zeros((48, 64), bool)
    mask[:, :32] = True
    masked = replace(scene, train=[replace(view, mask=mask) for view in scene.train])
    for point in dense(masked, device).points[60:]:
        seen = [view.camera.viewmat[:3, :3] @ point + view.camera.viewmat[:3, 3] for view in scene.train]
        assert min(60 * p[0] / p[2] + 32 for p in seen) < 32.5
    assert len(dense(masked, device, 10_000).points) < 0.7 * len(dense(scene, device, 10_000).points)


def test_what_a_mask_hides_does_not_matter(device: Device) -> None:
    scene = wall()
    mask = np.ones((48, 64), bool)
    mask[:, :20] = False
    black, white = (
        dense(
            replace(
                scene,
                train=[
                    replace(v, image=np.where(mask[:, :, None], v.image, np.uint8(fill)), mask=mask)
                    for v in scene.train
                ],
            ),
            device,
        )
        for fill in (0, 255)
    )
    np.testing.assert_array_equal(black.points, white.points)
    np.testing.assert_array_equal(black.colors, white.colors)


def test_scenes_that_tell_no_depths_stay_as_they_are(device: Device) -> None:
    scene = wall()
    without = replace(scene, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    assert dense(without, device) is without
    two, three = (replace(scene, train=scene.train[:count]) for count in (2, 3))
    assert dense(two, device) is two
    assert len(dense(three, device).points) > 60
    fisheyes = [view.with_camera(replace(view.camera, model="fisheye")) for view in scene.train]
    assert dense(replace(scene, train=fisheyes), device).points is scene.points


def test_photos_that_disagree_add_no_points(device: Device) -> None:
    rng = np.random.default_rng(2)
    scene = wall()
    views = [replace(view, image=rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)) for view in scene.train]
    # By chance a few windows of noise are alike.
    assert len(dense(replace(scene, train=views), device).points) < 60 + 0.01 * 4 * 64 * 48


def test_neighbours_see_the_same_from_elsewhere() -> None:
    scene = wall()
    cameras = [view.camera for view in scene.train]
    away = Camera.look_at((0, 0, 0), (0, 0, -1), (0, -1, 0), 60, 64, 48)
    found = neighbours([*cameras, away, cameras[0]], scene.points)
    assert found[0][0] == 1 and 4 not in found[0]
    assert found[4] == []
    assert found[0].index(1) < found[0].index(5), "a camera at the same place tells no depth"


def test_angles_below_the_best_one_count_less_than_those_above() -> None:
    """By hand: 4 degrees below it the weight is exp(-1/2), and 4 above exp(-1/18)."""
    points = np.random.default_rng(0).uniform(-0.01, 0.01, (60, 3))
    cameras = [
        Camera.look_at((5 * np.sin(a), 0, -5 * np.cos(a)), (0, 0, 0), (0, -1, 0), 60, 64, 48)
        for a in np.radians([0, 4, -12])
    ]
    assert neighbours(cameras, points)[0] == [2, 1]


def test_common_points_count_beyond_those_whose_angles_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.training.dense_start.MOST_ANGLES", 20)
    points = np.random.default_rng(0).uniform(-1, 1, (400, 3)) * (1, 1, 0.01)
    cameras = [
        Camera.look_at((5 * np.sin(a), 0, -5 * np.cos(a)), (0, 0, 0), (0, -1, 0), focal, 64, 64)
        for a, focal in ((0, 60), (0.14, 400), (-0.14, 60))
    ]
    assert neighbours(cameras, points)[0] == [2, 1], "the second camera shows fewer points"


def test_points_are_supported_by_sure_depths_of_two_photos() -> None:
    photos = wall().train

    def depths(camera: Camera, factor: float = 1, score: float = 1) -> Depths:
        """Where the rays of a camera meet the wall."""
        x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
        rays = np.stack([(x - 32) / 60, (y - 24) / 60, np.ones_like(x)], axis=-1)
        away = (WALL - camera.position[2]) / (rays @ camera.viewmat[:3, :3])[:, :, 2]
        return Depths(factor * away, np.full((48, 64), score))

    def found(own: float = 1, **others: float) -> np.ndarray:
        maps = [depths(photos[0].camera, score=own), *(depths(photo.camera) for photo in photos[1:])]
        maps[2:] = [depths(photo.camera, **others) for photo in photos[2:]]
        return agreed(0, photos, [1, 2, 3], maps)[0]

    points, colors, sizes = agreed(0, photos, [1, 2, 3], [depths(photo.camera) for photo in photos])
    assert len(points) > 1000
    np.testing.assert_allclose(points[:, 2], WALL, atol=1e-9)
    np.testing.assert_allclose(colors, 255 * wall_color(points[:, 0], points[:, 1]), atol=0.5 + 1e-6)
    expected = (points - photos[0].camera.position) @ photos[0].camera.viewmat[2, :3] / 60
    np.testing.assert_allclose(sizes, expected, rtol=1e-9)
    # Of the three others one alone agrees, where the depths of two differ or are unsure.
    assert not len(found(factor=1.03)) and not len(found(score=0.39)) and not len(found(own=0.59))
    assert len(found(score=0.41)) == len(found(own=0.61)) == len(found(factor=1.009)) == len(points)


def test_thinned_points_keep_to_the_number_where_their_sizes_differ() -> None:
    """Each size has a grid of its own: of four sizes, four cells remain, however large they are."""
    points = np.random.default_rng(0).uniform(size=(40, 3))
    assert len(thinned(points, np.repeat(4.0 ** np.arange(4), 10), 2, 0)) == 2


def test_thinned_points_are_spread() -> None:
    """A thousand points in one place and 64 elsewhere: cells, not points, have equal chances."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0, 0.1, (1000, 3)), rng.uniform(0, 10, (64, 3))])
    chosen = thinned(points, np.full(1064, 0.01), 80, 0)
    assert len(np.unique(chosen)) == len(chosen) <= 80
    assert (chosen >= 1000).sum() > 40


def test_configuration_and_memory_leave_dense_points_out(device: Device) -> None:
    scene, config = wall(), TrainConfig(iterations=3000)
    assert len(first_points(scene, config, device).points) > 500
    assert first_points(scene, replace(config, init=InitConfig(dense=False)), device) is scene
    assert len(first_points(scene, replace(config, max_gaussians=200), device).points) <= 100
    cheap = first_points(scene, replace(config, size_price=0.025), device)
    assert len(first_points(scene, config, device).points) <= 48 * 64 / 2 < len(cheap.points) <= 48 * 64
    small = Device(device.cl_device, memory_limit=2_000_000)
    assert first_points(scene, config, small) is scene


def test_dense_points_take_no_more_memory_than_is_said(device: Device) -> None:
    counted = Device(device.cl_device)
    assert len(dense(wall(), counted).points) > 500
    assert counted.memory_peak <= BYTES * 64 * 48


def test_training_starts_with_dense_points(device: Device, tmp_path) -> None:
    config = TrainConfig(iterations=1, size="fixed", max_gaussians=800, eval_every=0, init=InitConfig(sky=False))
    counts = []
    train(wall(), config, tmp_path, device, progress=lambda now: counts.append(now["num_gaussians"]))
    assert 300 < counts[0] <= 400


def test_growth_reaches_no_more_from_a_dense_start() -> None:
    """48x64 pixels: 3072 Gaussians at most, from 60 points or from 1536; but never fewer than there are."""
    scene, config = wall(), TrainConfig(iterations=3000)
    windows = len(rule.growth_bounds(config)) - 1
    for first, reached in ((60, 3072), (1536, 3072), (4000, 4000)):
        assert rule.start(scene, first, config).pace ** windows * first == pytest.approx(reached)
    many = replace(scene, points=np.zeros((2000, 3)))
    assert rule.start(many, 2000, config).pace ** windows * 2000 == pytest.approx(6000)
