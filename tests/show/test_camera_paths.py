"""The point that the cameras look at, the path around it, and viewpoints of scenes without cameras."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from clsplat.camera import Camera, focus_point
from clsplat.errors import InputError
from clsplat.pruning.viewpoints import STATIONS, surround
from clsplat.show.camera_paths import around, first_photo, orbit, overview, through
from clsplat.testing import synthetic_scene

TARGET = np.array([1.0, -2.0, 3.0])
UP = np.array([0.0, 0.6, 0.8])
EAST = np.array([1.0, 0.0, 0.0])


def ring(angles, radius=5.0, height=2.0):
    """Cameras on a ring around TARGET. Their up direction is UP."""
    north = np.cross(UP, EAST)
    arms = [radius * (np.cos(a) * EAST + np.sin(a) * north) + height * UP for a in angles]
    return [Camera.look_at(TARGET + arm, TARGET, UP, 500.0, 640, 480) for arm in arms]


def test_focus_is_where_the_axes_meet():
    cameras = ring(np.linspace(0, 2, 7))
    np.testing.assert_allclose(focus_point(cameras), TARGET, atol=1e-12)
    # Far from the origin only the rounding of the positions in float64 remains.
    offset = np.array([5e5, 5.6e6, 300.0])
    far = [camera.translated(-offset) for camera in cameras]
    np.testing.assert_allclose(focus_point(far), TARGET + offset, atol=1e-7)


def test_focus_minimises_the_distances_from_the_axes():
    rng = np.random.default_rng(0)
    cameras = [Camera.look_at(rng.normal(size=3) * 5, rng.normal(size=3), UP, 500.0, 640, 480) for _ in range(9)]
    positions = np.array([c.position for c in cameras])
    axes = np.array([c.viewmat[2, :3] for c in cameras])

    def cost(p):
        return (np.cross(p - positions, axes) ** 2).sum()

    best = focus_point(cameras)
    for step in np.vstack([np.eye(3), -np.eye(3)]) * 1e-3:
        assert cost(best) < cost(best + step)


def test_focus_without_an_intersection_in_front():
    parallel = [Camera.look_at([x, 0, 0], [x, 0, 9], UP, 500.0, 640, 480) for x in (-3, 0, 3)]
    np.testing.assert_allclose(focus_point(parallel), [0, 0, 3], atol=1e-12)
    # Half a degree between the axes does not count as an intersection: at 300 units, with 3 units between the
    # cameras.
    nearly = [Camera.look_at([x, 0, 0], [0, 0, 300], UP, 500.0, 640, 480) for x in (-3, 0, 3)]
    np.testing.assert_allclose(focus_point(nearly), [0, 0, 3], atol=1e-3)
    outwards = [
        Camera.look_at([x, 0, z], [3 * x, 0, 3 * z], UP, 500.0, 640, 480) for x, z in [(-1, 2), (0, 2), (1, 2)]
    ]
    focus = focus_point(outwards)
    assert focus[2] > 2, "the axes meet behind the cameras, at the origin"
    np.testing.assert_allclose(focus_point(ring([0])), ring([0])[0].position + ring([0])[0].viewmat[2, :3])
    with pytest.raises(InputError, match="at least one camera"):
        focus_point([])


def test_a_full_ring_gives_a_full_circle():
    cameras = ring(np.linspace(0, 2 * np.pi, 12, endpoint=False) + 0.3)
    path = orbit(cameras, 8, 320, 240)
    arms = np.array([c.position for c in path]) - TARGET
    np.testing.assert_allclose(arms @ UP, 2, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(arms - 2 * UP, axis=1), 5, atol=1e-9)
    np.testing.assert_allclose(arms[0], cameras[0].position - TARGET, atol=1e-9)
    steps = np.linalg.norm(np.diff(arms, axis=0, append=arms[:1]), axis=1)
    np.testing.assert_allclose(steps, 2 * 5 * np.sin(np.pi / 8), atol=1e-9)
    for camera in path:
        np.testing.assert_allclose(camera.viewmat @ [*TARGET, 1], [0, 0, np.sqrt(29), 1], atol=1e-9)
        assert camera.viewmat[1, :3] @ UP < 0, "y points down"


def test_the_path_swings_over_an_arc_and_never_leaves_it():
    arc = np.array([2.9, 3.3, 3.0, 3.5, 4.0])  # across the seam of arctan2
    path = orbit(ring(arc, height=0.0), 40, 320, 240)
    arms = np.array([c.position for c in path]) - TARGET
    angles = np.arctan2(arms @ np.cross(UP, EAST), arms @ EAST) % (2 * np.pi)
    assert angles.min() == pytest.approx(2.9) and angles.max() == pytest.approx(4.0)
    assert np.abs(np.diff(angles, append=angles[:1])).max() < 0.1, "no jump, not even where the video loops"


@pytest.mark.parametrize(("arc", "full"), [(260, False), (280, True)])
def test_a_gap_of_a_quarter_of_the_circle_is_not_crossed(arc, full):
    angles = np.radians(np.linspace(0, arc, 14))
    path = orbit(ring(angles), 36, 64, 48)
    arms = np.array([c.position for c in path]) - TARGET
    found = np.degrees(np.arctan2(arms @ np.cross(UP, EAST), arms @ EAST)) % 360
    inside = (found < arc + 1e-6) | (found > 360 - 1e-6)  # 0 may be 360, by rounding
    assert inside.all() != full


def test_one_camera_and_one_frame():
    (camera,) = ring([1.0])
    (frame,) = orbit([camera], 1, 640, 480)
    np.testing.assert_allclose(frame.position, camera.position, atol=1e-9)


@pytest.mark.parametrize(
    ("width", "height", "fx"), [(640, 480, 500), (1280, 480, 500), (320, 480, 250), (64, 48, 50)]
)
def test_the_first_cameras_field_of_view_fits_the_frame(width, height, fx):
    camera = orbit(ring([0, 1, 2]), 3, width, height)[1]
    assert (camera.width, camera.height, camera.cx, camera.cy) == (width, height, width / 2, height / 2)
    assert camera.fx == camera.fy == fx


@pytest.mark.parametrize("fy", [250, 1000])
def test_pixels_of_the_first_camera_need_not_be_square(fy):
    cameras = [replace(camera, fy=fy) for camera in ring([0, 1, 2])]
    assert orbit(cameras, 1, 640, 480)[0].fx == min(500, fy)


def test_radius_and_height_are_means():
    turn = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    top = Camera.look_at(TARGET + 9 * UP, TARGET, EAST, 500.0, 640, 480)
    arms = (
        np.array([c.position for c in orbit([top, *ring(turn, 4.0, 1.0), *ring(turn, 8.0, 2.0)], 4, 64, 48)]) - TARGET
    )
    centre = arms.mean(axis=0)
    # The camera above sees EAST as up and tilts the axis by a few degrees.
    assert np.linalg.norm(arms - centre, axis=1) == pytest.approx(16 * 6 / 17, rel=0.02)
    assert np.linalg.norm(centre) == pytest.approx((8 + 16 + 9) / 17, rel=0.02)


def test_cameras_without_an_orbit_are_refused():
    with pytest.raises(InputError, match="frames"):
        orbit(ring([0, 1]), 0, 64, 48)
    turn = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    panorama = [Camera.look_at([0, 0, 0], [np.cos(a), np.sin(a), 0], [0, 0, 1], 500.0, 640, 480) for a in turn]
    with pytest.raises(InputError, match="found all of them in one place"):
        orbit(panorama, 4, 64, 48)


def test_cameras_upside_down_to_each_other():
    cameras = [Camera.look_at(TARGET + x * EAST, TARGET, x * UP, 500.0, 640, 480) for x in (4, -4)]
    path = np.array([frame.position for frame in orbit(cameras, 4, 64, 48)])
    # Half a circle between the two, over the top or through the side, at their distance.
    np.testing.assert_allclose(np.linalg.norm(path - TARGET, axis=1), 4, atol=1e-9)
    np.testing.assert_allclose(np.sort((path - TARGET) @ EAST), [-4, 0, 0, 4], atol=1e-9)


@pytest.mark.shared
@pytest.mark.parametrize("name", ["fox_pinhole", "bonsai", "fern", "sceaux", "castle_p30"])
def test_real_scenes_are_visible_from_the_orbit(shared, name):
    import pycolmap

    reconstruction = pycolmap.Reconstruction(shared / "data" / name / "sparse" / "0")
    (intrinsics,) = reconstruction.cameras.values()
    cameras = []
    for image in sorted(reconstruction.images.values(), key=lambda image: image.name):
        viewmat = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        cameras.append(Camera(viewmat, *intrinsics.params, intrinsics.width, intrinsics.height))
    points = np.array([point.xyz for point in reconstruction.points3D.values()])

    def share_seen(camera):
        x, y, z = camera.viewmat[:3, :3] @ points.T + camera.viewmat[:3, 3:]
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        return np.mean((z > 0.01) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height))

    path = orbit(cameras, 12, intrinsics.width, intrinsics.height)
    photos = np.mean([share_seen(camera) for camera in cameras])
    # At least half of the points that a photo sees. A path that looks elsewhere sees a tenth.
    assert np.mean([share_seen(camera) for camera in path]) > 0.5 * photos


def test_surround_stands_around_the_scene():
    """Evenly in all directions, unaffected by a far background: the radius is the median distance."""
    gaussians = synthetic_scene(4000, 1)[0]
    rng = np.random.default_rng(0)
    arms = rng.normal(size=(4000, 3))
    gaussians.means[:] = TARGET + 2 * arms / np.linalg.norm(arms, axis=1, keepdims=True)
    gaussians.means[:40] *= 50
    gaussians.logit_opacities[:] = 1
    stations = surround(gaussians, 50, 640, 480)
    assert [len(cameras) for cameras in stations] == [50] * len(STATIONS)
    for cameras, (distance, gaze) in zip(stations, STATIONS, strict=True):
        arms = np.array([camera.position for camera in cameras]) - TARGET
        lengths = np.linalg.norm(arms, axis=1)
        np.testing.assert_allclose(lengths, 2 * distance, rtol=0.15)
        directions = arms / lengths[:, None]
        assert np.linalg.norm(directions.mean(axis=0)) < 0.15
        nearest = np.sort(directions @ directions.T, axis=1)[:, -2]
        assert nearest.max() < np.cos(np.radians(15)), "two cameras stand together"
        gazes = np.array([camera.viewmat[2, :3] for camera in cameras])
        assert (gaze * (gazes * directions).sum(axis=1) > 0.95).all()
    fov = 2 * np.arctan(320 / stations[0][0].fx)
    assert fov == pytest.approx(np.pi / 3)


def test_surround_of_a_single_gaussian():
    for cameras in surround(synthetic_scene(1)[0], 5, 64, 48):
        assert all(np.isfinite(camera.viewmat).all() for camera in cameras)


def test_overview_has_the_scene_in_the_middle_upright_from_above():
    rng = np.random.default_rng(2)
    gaussians, _ = synthetic_scene(400, seed=1)
    gaussians.means[:] = rng.normal([3, -1, 7], 0.5, (400, 3))
    gaussians.means[:40] = rng.normal(0, 500, (40, 3))  # a far background must not move the viewpoint
    camera, focus, up = overview(gaussians)
    np.testing.assert_allclose(focus, [3, -1, 7], atol=0.15)
    np.testing.assert_array_equal(up, [0, -1, 0])
    assert camera.position[1] < focus[1]
    x, y, z = camera.viewmat[:3, :3] @ gaussians.means[40:].T + camera.viewmat[:3, 3:]
    for pixels, size in (
        (camera.fx * x / z + camera.cx, camera.width),
        (camera.fy * y / z + camera.cy, camera.height),
    ):
        assert (np.abs(pixels / size - 0.5) < 0.5).mean() > 0.95
    assert camera.viewmat[1, 1] > 0.9, "y down is down in the image"


def test_first_photo_is_the_first_camera_with_the_mean_up_direction():
    up = np.array([0.2, -1.0, 0.1])
    cameras = [
        Camera.look_at(
            [4 * np.sin(a), -1, 4 * np.cos(a)], [0, 0, 0], up + 0.3 * np.array([np.sin(a), 0, 0]), 50, 40, 30
        )
        for a in np.arange(8) * np.pi / 4
    ]
    camera, focus, found = first_photo(cameras)
    assert camera is cameras[0]
    np.testing.assert_allclose(focus, 0, atol=1e-9)
    assert np.linalg.norm(found) == pytest.approx(1)
    assert found @ up / np.linalg.norm(up) > 0.98


class TestThrough:
    def stops(self):
        return [
            replace(Camera.look_at((3 * np.sin(a), -1, 3 * np.cos(a)), (0, 0, 0), (0, -1, 0), 40 + a, 64, 48))
            for a in (0.0, 1.0, 2.5, 4.0)
        ]

    def test_it_meets_each_camera_at_equal_intervals(self):
        stops = self.stops()
        path = through(stops, 31)
        assert len(path) == 31
        for stop, camera in zip(stops, path[::10], strict=True):
            np.testing.assert_allclose(camera.viewmat, stop.viewmat, atol=1e-9)
            assert camera.fx == pytest.approx(stop.fx)
        steps = [np.linalg.norm(b.position - a.position) for a, b in pairwise(path)]
        assert max(steps) < 3 * np.median(steps), "no jump"

    def test_a_closed_path_returns(self):
        path = through(self.stops(), 400, closed=True)
        for stop, camera in zip(self.stops(), path[::100], strict=True):
            np.testing.assert_allclose(camera.viewmat, stop.viewmat, atol=1e-9)
        first, last = (path[k].position - path[k - 1].position for k in (1, 0))
        # Of a smooth path, two steps of a quarter of a degree differ by about a hundredth.
        np.testing.assert_allclose(first, last, atol=0.03 * np.linalg.norm(first))

    def test_a_zoom_alone_is_a_path(self):
        first = self.stops()[0]
        path = through([first, replace(first, fx=2 * first.fx, fy=2 * first.fy)], 3)
        assert [camera.fx for camera in path] == pytest.approx([40, 60, 80])
        assert [camera.fy for camera in path] == pytest.approx([40, 60, 80])

    def test_equal_neighbours_count_once_and_one_camera_is_no_path(self):
        first, second, *_ = self.stops()
        assert len(through([first, first, second], 5)) == 5
        for cameras, frames in (([first, first], 5), ([first, second], 0)):
            with pytest.raises(InputError, match="two different cameras"):
                through(cameras, frames)


def test_around_keeps_the_distance_and_the_height():
    camera = Camera.look_at((2, -1, 0), (0, 0, 0), (0, -1, 0), 50, 64, 48)
    path = around(camera, np.zeros(3), np.array([0.0, -1, 0]), 8)
    np.testing.assert_allclose(path[0].viewmat, camera.viewmat, atol=1e-12)
    centres = np.array([c.position for c in path])
    np.testing.assert_allclose(centres[:, 1], -1)
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), np.sqrt(5))
    np.testing.assert_allclose(centres[4], [-2, -1, 0], atol=1e-12)
    for c in path:  # each looks at the focus
        np.testing.assert_allclose((c.viewmat @ [0, 0, 0, 1])[:2], 0, atol=1e-12)
