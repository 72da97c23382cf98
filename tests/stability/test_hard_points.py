"""Points and poses far from what a scene has: duplicates, outliers, cameras that see nothing, impossible poses."""

import resource
import sys
from dataclasses import replace

import numpy as np
import pytest
import scipy.spatial
from hard_data import end, frame, write

from clsplat.bench.stability.small import CONFIG, SIZE, known_gaussians, small_scene
from clsplat.camera import Camera
from clsplat.config import InitConfig
from clsplat.errors import InputError
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.training.initialize import NEIGHBOURS, from_points
from clsplat.training.loop import train


@pytest.fixture(scope="module")
def scene(device):
    return small_scene(device)


@pytest.fixture
def trained(capsys, device, tmp_path):
    """Write a scene, with other frames if they are given, train on it with the command, and return how that ended."""

    def run(scene, *options, frames=None, size="fixed"):
        data = write(tmp_path / "data", scene, frames)
        return end(capsys, device, data, tmp_path / "out", *options, size=size)

    return run


def at_points(scene, points):
    """The scene with other points, all grey."""
    return replace(scene, points=points, colors=np.full(points.shape, 128, np.uint8))


def with_cameras(scene, camera):
    """The scene with `camera(camera)` for the cameras of its training photos."""
    return replace(scene, train=[replace(view, camera=camera(view.camera)) for view in scene.train])


def towards(camera, eye, target):
    return Camera.look_at(eye, target, [0, -1, 0], camera.fx, camera.width, camera.height)


def test_cameras_inside_the_points(scene, trained, device):
    """Photos taken in the middle of the Gaussians, outwards."""
    truth = known_gaussians()

    def photo(view):
        camera = towards(view.camera, 0.05 * view.camera.position, view.camera.position * [1, 0, 1])
        return replace(view, camera=camera, image=to_uint8(render(truth, camera, device=device).rgb))

    found = trained(replace(scene, train=[photo(view) for view in scene.train]))
    assert found.sentence or found.gain > 1


@pytest.mark.parametrize("where", ["all look away", "all points behind"])
def test_cameras_that_see_no_point_fail_by_a_sentence(scene, trained, where):
    if where == "all look away":
        hard = with_cameras(scene, lambda c: towards(c, c.position, 2 * c.position))
    else:
        hard = with_cameras(scene, lambda c: towards(c, [c.position[0] / 9, 0, 5], [c.position[0] / 9, 0, 20]))
    assert "where a constant colour for each has" in trained(hard).sentence


def test_duplicate_points_do_not_slow_the_search_for_neighbours(monkeypatch):
    """A tree of equal points is searched as a list: a million of them took hours."""
    sizes, tree = [], scipy.spatial.cKDTree

    def counted(points):
        sizes.append(len(points))
        return tree(points)

    monkeypatch.setattr(scipy.spatial, "cKDTree", counted)
    points = np.repeat([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]], [5000, 2, 1], axis=0)
    found = from_points(points, np.zeros(points.shape, np.uint8), InitConfig())
    assert sizes == [NEIGHBOURS + 1 + 2 + 1]
    # The mean square distances to the three nearest other points: 0; (0 + 1 + 1)/3; (4 + 4 + 4)/3.
    variances = np.exp(2 * found.log_scales[[5000, 5002], 0].astype(float))
    np.testing.assert_allclose(variances, [2 / 3, 4], rtol=1e-5)


def test_duplicate_points_alone_fail_by_a_sentence(scene, trained):
    found = trained(at_points(scene, np.tile(scene.points[:1], (1000, 1))), size="auto")
    assert "where a constant colour for each has" in found.sentence


@pytest.mark.slow
def test_a_million_duplicate_points_end(scene, trained):
    found = trained(
        at_points(scene, np.tile(scene.points[:1], (1_000_000, 1))), "--iterations", 2, "--test-every", 0, size="auto"
    )
    assert "where a constant colour for each has" in found.sentence


def test_outliers_cost_little(scene, trained):
    points = scene.points.copy()
    points[::10] *= 1e12
    assert trained(at_points(scene, points)).gain > 3


def test_points_that_are_all_far_away_end(scene, trained):
    trained(at_points(scene, scene.points * 1e12))


@pytest.mark.parametrize("outlier", [1e39, 1e300])
def test_points_beyond_float32_are_refused(scene, trained, outlier):
    points = scene.points.copy()
    points[0] = outlier
    found = trained(at_points(scene, points))
    assert found.error and f"found {outlier:.3g}; remove such points" in found.sentence
    with pytest.raises(InputError, match="points: expected finite coordinates, as float32"):
        from_points(points, scene.colors, InitConfig())


@pytest.mark.parametrize("change", ["nan", "scaled", "mirrored", "sheared"])
def test_impossible_poses_are_refused_by_the_photos_name(scene, trained, change):
    pose = np.linalg.inv(scene.train[3].camera.viewmat) @ np.diag([1.0, -1, -1, 1])
    if change == "nan":
        pose[0, 3] = np.nan
    else:
        matrices = {
            "scaled": np.diag([1.5] * 3),
            "mirrored": np.diag([-1, 1, 1]),
            "sheared": np.eye(3) + np.eye(3, k=1),
        }
        pose[:3, :3] = pose[:3, :3] @ matrices[change]
    frames = [frame(view, pose if i == 3 else None) for i, view in enumerate(scene.train)]
    found = trained(scene, frames=frames)
    assert found.error and "train03.png" in found.sentence


def test_a_pose_at_another_place_altogether_fails_by_a_sentence(scene, trained):
    """One camera 10^12 away: float32 resolves no step of the others."""
    pose = np.linalg.inv(scene.train[3].camera.viewmat) @ np.diag([1.0, -1, -1, 1])
    pose[:3, 3] += 1e12
    found = trained(scene, frames=[frame(view, pose if i == 3 else None) for i, view in enumerate(scene.train)])
    assert "where a constant colour for each has" in found.sentence


@pytest.mark.slow
def test_five_million_gaussians_fit_24_gb(scene, device, tmp_path, monkeypatch):
    """One iteration, and a render, of tiny photos; without the search for neighbours, which takes minutes."""
    # By its name, the module is hidden by the function that the package exports.
    module = sys.modules["clsplat.training.initialize"]
    monkeypatch.setattr(module, "_variances", lambda points: np.full(len(points), 0.005**2))
    count = 5_000_000
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (count, 3))
    config = replace(CONFIG, iterations=1, max_gaussians=count, init=InitConfig(sh_degree=3))
    found = train(at_points(scene, points), config, tmp_path, device)
    image = render(found, scene.test[0].camera, device=device, gradients=False).rgb
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{len(found)} Gaussians, peak memory: {peak:.1f} GiB")
    assert len(found) > 0.9 * count and image.shape == (*SIZE[::-1], 3) and np.isfinite(image).all()
    assert peak < 24
