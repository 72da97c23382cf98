"""Near planes of photos, by the points that they show."""

from dataclasses import replace

import numpy as np
import pytest
from test_loading import write_colmap

from clsplat.camera import Camera, default_near
from clsplat.config import DataConfig
from clsplat.constants import NEAR, NEAR_EXTENTS
from clsplat.dataset import load_scene
from clsplat.dataset.near_planes import NEAR_SHARE, near_plane, with_near_planes
from clsplat.errors import InputError
from clsplat.render import render
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene


def test_nothing_is_drawn_long_before_the_nearest_points(tmp_path):
    """By hand: 100 points at 3 to 3.99 in front of the first photos and one outlier at 0.5; other photos see none,
    and have the near plane of the first ones. Held-out photos have near planes, too."""
    write_colmap(tmp_path)
    rows = [f"{k} 0.3 0 {3 + k / 100} 0 0 0 0\n" for k in range(100)]
    (tmp_path / "sparse" / "0" / "points3D.txt").write_text("".join([*rows, "100 0.3 0 0.5 0 0 0 0\n"]))
    scene = load_scene(tmp_path, DataConfig())
    views = sorted(scene.train + scene.test, key=lambda view: view.name)
    found = [near_plane(view.camera, scene.points) for view in views]
    assert None in found and found[0] == pytest.approx(NEAR_SHARE * 3.0, abs=0.01), found
    nearest = min(near for near in found if near is not None)
    assert [view.camera.near for view in views] == [near or nearest for near in found]
    assert near_plane(views[0].camera, scene.points[:99]) is None, "too few to recognise an outlier"
    assert near_plane(views[0].camera, scene.points[:0]) is None
    (tmp_path / "sparse" / "0" / "points3D.txt").write_text("")
    bare = load_scene(tmp_path, DataConfig())
    assert {view.camera.near for view in bare.train} == {NEAR_EXTENTS * bare.extent}


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3])
def test_near_planes_are_in_the_units_of_the_scene(tmp_path, unit):
    write_colmap(tmp_path)
    rows = [f"{k} 0.3 0 {3 + k / 100} 0 0 0 0\n" for k in range(100)]
    (tmp_path / "sparse" / "0" / "points3D.txt").write_text("".join(rows))
    scene = load_scene(tmp_path, DataConfig())

    def scaled(views):
        cameras = [view.camera for view in views]
        viewmats = [np.block([[c.viewmat[:3, :3], unit * c.viewmat[:3, 3:]], [np.eye(4)[3:]]]) for c in cameras]
        return [
            replace(view, camera=replace(view.camera, viewmat=viewmat, near=None))
            for view, viewmat in zip(views, viewmats, strict=True)
        ]

    other = replace(scene, train=scaled(scene.train), test=scaled(scene.test), points=unit * scene.points)
    found = [view.camera.near for view in with_near_planes(other).train]
    np.testing.assert_allclose(found, [unit * view.camera.near for view in scene.train], rtol=1e-9)


def test_a_near_plane_that_is_given_is_kept(tmp_path):
    write_colmap(tmp_path)
    scene = load_scene(tmp_path, DataConfig())
    first = replace(scene.train[0], camera=replace(scene.train[0].camera, near=0.125))
    rest = [replace(view, camera=replace(view.camera, near=None)) for view in scene.train[1:]]
    nears = [view.camera.near for view in with_near_planes(replace(scene, train=[first, *rest])).train]
    assert nears[0] == 0.125 and None not in nears


@pytest.mark.parametrize("unit", [2.0**-20, 2.0**10])
@pytest.mark.parametrize("model", ["pinhole", "equirectangular"])
def test_an_image_does_not_depend_on_the_units(device, unit, model):
    """Cameras without a near plane. Powers of two are exact in float32, but for the logarithms of the scales."""
    gaussians, camera = synthetic_scene(50, sh_degree=0)
    other = replace(gaussians, means=unit * gaussians.means, log_scales=gaussians.log_scales + np.log(unit))
    moved = camera.viewmat.copy()
    moved[:3, 3] *= unit
    cameras = [replace(camera, viewmat=viewmat, model=model, near=None) for viewmat in (camera.viewmat, moved)]
    images = [
        render(g, c, device=device, gradients=False).rgb for g, c in zip((gaussians, other), cameras, strict=True)
    ]
    assert images[0].max() > 0.1
    np.testing.assert_allclose(images[0], images[1], atol=1e-3)  # the rounding of the logarithms


def test_default_near_planes():
    """By hand: the median distance of 1, 1, 1, 1 and 0 from their median 0 is 1."""
    means = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 0]], np.float32)
    assert default_near(means) == pytest.approx(NEAR_EXTENTS)
    poisoned = np.append(means, [[np.nan, 0, 0], [0, np.inf, 0]], axis=0).astype(np.float32)
    assert default_near(poisoned) == default_near(means) and default_near(poisoned[5:]) == NEAR
    assert default_near(1e-30 * means) > np.finfo(np.float32).tiny
    assert default_near(means[:1]) == NEAR == Camera(np.eye(4), 1, 1, 1, 1, 2, 2).near_depth


def test_a_photo_without_points_has_the_nearest_plane_of_the_others():
    """Photos from 3 and 6 units away, and one that looks away."""
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
    photo = np.zeros((20, 20, 3), np.uint8)
    poses = [((0, 0, -3), (0, 0, 0)), ((0, 0, -6), (0, 0, 0)), ((0, 0, -3), (0, 0, -9))]
    cameras = [Camera.look_at(position, target, (0, -1, 0), 60, 20, 20) for position, target in poses]
    views = [View(f"{k}.png", camera, photo) for k, camera in enumerate(cameras)]
    scene = Scene(views, [], points, np.zeros((200, 3), np.uint8))
    nearest, farther, away = (view.camera.near for view in with_near_planes(scene).train)
    assert nearest == away < farther


@pytest.mark.parametrize("near", [0.0, -1.0, np.nan, np.inf, 1e-50])
def test_a_near_plane_that_is_no_depth_is_refused(near):
    with pytest.raises(InputError, match="near"):
        Camera(np.eye(4), 1, 1, 1, 1, 2, 2, near=near)
