"""Cameras: invalid values are refused, and the geometry of known cases."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera, focus_point, pixel_rays
from clsplat.errors import InputError


def make(**changes):
    fields = {"viewmat": np.eye(4), "fx": 50, "fy": 60, "cx": 32, "cy": 24, "width": 64, "height": 48}
    return Camera(**(fields | changes))


def viewmat_with(rotation):
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    return viewmat


def random_camera(seed=0):
    rng = np.random.default_rng(seed)
    return Camera.look_at(rng.normal(size=3), rng.normal(size=3), (0, 0, 1), 80, 64, 48)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"viewmat": np.eye(3)}, r"viewmat: expected shape \(4, 4\), found \(3, 3\)"),
        ({"viewmat": np.full((4, 4), np.nan)}, "expected finite viewmat"),
        ({"cx": np.inf}, "expected finite viewmat and intrinsics"),
        ({"fx": 0}, "positive focal lengths, as float32, found fx=0"),
        ({"fy": -1}, "positive focal lengths"),
        ({"width": 0}, "at least 1x1, found 0x48"),
        ({"width": 64.0}, "width: expected an integer, found 64.0"),
        ({"height": "48"}, "height: expected an integer, found '48'"),
        ({"viewmat": viewmat_with(np.diag([1, 1, -1]))}, "determinant -1"),
        ({"viewmat": viewmat_with(2 * np.eye(3))}, "determinant 8"),
        ({"viewmat": viewmat_with([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])}, "expected a rotation"),
    ],
)
def test_refused(changes, message):
    with pytest.raises(InputError, match=message):
        make(**changes)


def test_a_transposed_pose_is_refused():
    with pytest.raises(InputError, match=r"viewmat: expected 0, 0, 0, 1 in its last row, found .*; transpose"):
        make(viewmat=random_camera().viewmat.T)
    make(viewmat=np.linalg.inv(np.linalg.inv(random_camera().viewmat).astype(np.float32)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((1, 2, 3), (1, 2, 3), (0, 0, 1)), "position, target: expected two points, found 1, 2, 3 for both"),
        (((0, 0, 3), (0, 0, 0), (0, 0, 1)), "up: expected a direction not parallel"),
        (((0, 1, 3), (0, 0, 0), (0, 0, 0)), "up: expected a direction not parallel"),
    ],
)
def test_points_from_which_no_camera_follows(arguments, message):
    with pytest.raises(InputError, match=message):
        Camera.look_at(*arguments, 80, 64, 48)


def test_a_size_of_numpy_is_one_of_python():
    camera = make(width=np.int64(64), height=np.uint16(48))
    assert type(camera.width) is type(camera.height) is int


def test_poses_of_four_digits_are_accepted():
    make(viewmat=np.round(random_camera().viewmat, 4))


def test_viewmat_is_float64_and_contiguous():
    camera = make(viewmat=np.asfortranarray(random_camera().viewmat.astype(np.float32)))
    assert camera.viewmat.dtype == np.float64 and camera.viewmat.flags.c_contiguous


def test_a_camera_does_not_follow_the_arrays_of_its_arguments():
    viewmat, distortion = random_camera().viewmat.copy(), np.array([0.1, 0.0, 0.0, 0.0])
    camera = make(viewmat=viewmat, distortion=distortion, model="fisheye")
    position, directions = camera.position.copy(), pixel_rays(camera)
    viewmat[0, 3] += 0.5
    distortion[0] = 0.2
    assert camera.distortion == (0.1, 0, 0, 0)
    np.testing.assert_array_equal(replace(camera).position, position)
    np.testing.assert_array_equal(pixel_rays(replace(camera)), directions)
    with pytest.raises(ValueError, match="read-only"):
        camera.viewmat[0, 3] += 0.5


def test_intrinsic_matrix():
    np.testing.assert_array_equal(make().K, [[50, 0, 32], [0, 60, 24], [0, 0, 1]])


def test_position_is_where_the_camera_frame_has_its_origin():
    camera = random_camera()
    np.testing.assert_allclose(camera.viewmat @ [*camera.position, 1], [0, 0, 0, 1], atol=1e-14)


def test_look_at():
    camera = Camera.look_at((0, -5, 1), (0, 0, 1), (0, 0, 1), 80, 64, 48)
    np.testing.assert_allclose(camera.position, (0, -5, 1), atol=1e-15)
    # In camera coordinates +z is forward, +x right, -y up.
    for point, expected in [((0, 0, 1), (0, 0, 5)), ((1, 0, 1), (1, 0, 5)), ((0, 0, 3), (0, -2, 5))]:
        np.testing.assert_allclose(camera.viewmat @ [*point, 1], [*expected, 1], atol=1e-15)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (80, 80, 32, 24)


def test_resized_projects_to_the_same_place_of_the_image():
    camera = make()
    small = camera.resized(32, 12)
    point = np.array([0.3, -0.2, 2])
    x, y, z = camera.K @ point
    u, v, w = small.K @ point
    np.testing.assert_allclose([u / w / 32, v / w / 12], [x / z / 64, y / z / 48])
    assert (small.width, small.height) == (32, 12)


def test_translated_sees_a_moved_world_as_before():
    camera, point, offset = random_camera(), np.array([1.0, 2, 3]), np.array([4e5, -5e6, 30])
    moved = camera.translated(offset)
    np.testing.assert_allclose(moved.viewmat @ [*(point - offset), 1], camera.viewmat @ [*point, 1], atol=1e-8)
    np.testing.assert_allclose(moved.position, camera.position - offset)


class TestFocusPoint:
    def test_cameras_around_a_point(self):
        target = np.array([1e6, -2e6, 3e3])
        eyes = target + np.random.default_rng(0).normal(size=(12, 3))
        cameras = [Camera.look_at(eye, target, (0.1, 0.2, 1), 50, 64, 48) for eye in eyes]
        np.testing.assert_allclose(focus_point(cameras), target, atol=1e-6)

    def test_one_camera(self):
        camera = Camera.look_at((1, 2, 3), (1, 2, 9), (0, 1, 0), 50, 64, 48)
        np.testing.assert_allclose(focus_point([camera]), (1, 2, 4))

    def test_cameras_at_one_position_apart_from_rounding(self):
        eyes = np.array([1.0, 2, 3]) + 1e-15 * np.random.default_rng(0).normal(size=(4, 3))
        cameras = [Camera.look_at(eye, eye + np.array([0, 0, 6]), (0, 1, 0), 50, 64, 48) for eye in eyes]
        np.testing.assert_allclose(focus_point(cameras), (1, 2, 4))

    def test_parallel_axes(self):
        cameras = [Camera.look_at((x, 0, 0), (x, 0, 1), (0, 1, 0), 50, 64, 48) for x in (-2, 0, 2)]
        np.testing.assert_allclose(focus_point(cameras), (0, 0, 2), atol=1e-12)

    def test_cameras_that_look_away_from_each_other(self):
        cameras = [Camera.look_at(d, 3 * np.array(d), (0, 0, 1), 50, 64, 48) for d in ([1.0, 0, 0], [0, 1.0, 0])]
        ahead = np.mean([[1, 0, 0], [0, 1, 0]], axis=0)
        point = focus_point(cameras)
        assert (point - ahead) @ ahead > 0, "in front of the cameras, not behind them, where the axes meet"

    def test_no_camera(self):
        with pytest.raises(InputError, match="at least one camera"):
            focus_point([])
