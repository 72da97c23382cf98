"""Camera paths and viewpoints: an orbit around the scene, and the first view that a viewer shows."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, focus_point
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.pruning.viewpoints import FIELD_OF_VIEW, bounds

Array = NDArray[Any]

FULL_CIRCLE_GAP = math.pi / 2
"""Angle between neighbouring photos, radians, from which on the path is no full circle but swings back and forth over
the remaining arc. Gaussians look arbitrary from directions without a photo."""

OVERVIEW_HEIGHT = math.radians(20)
"""Elevation of `overview` above the horizon, radians: the angle at which a person looks at a table."""

OVERVIEW_RADII = 3.5
"""Distance of `overview` from the scene's centre, in radii of the scene. A ball of one radius holds half of the
scene's weight. At this distance, two radii are visible."""

OVERVIEW_SIZE = (1280, 720)
"""Width and height of `overview`, px."""


def orbit(cameras: list[Camera], frames: int, width: int, height: int) -> list[Camera]:
    """Cameras on a horizontal circle around the scene's focus, for a video that loops.

    The centre is `focus_point`. The axis is the mean of the cameras' up vectors. Radius and height above the centre
    are means over the cameras. If a quarter of the circle or more has no photo, the path swings smoothly back and
    forth over the arc that the cameras cover.

    Parameters
    ----------
    cameras : list of Camera
        The training cameras. Each frame has square pixels and the field of view of the first one, so that it shows at
        least what the first photo shows.
    frames : int
        Number of cameras on the path, at least 1.
    width, height : int
        Size of the frames, px.

    Returns
    -------
    list of Camera
        In the coordinates of `cameras`.

    Raises
    ------
    InputError
        If there is no camera or no frame, or if all cameras stand at the focus, as in a panorama from one place.
    """
    centre = focus_point(cameras)
    if frames < 1:
        raise InputError(f"frames: expected at least 1, found {frames}")
    up = _up(cameras)

    arms = np.array([camera.position for camera in cameras]) - centre
    heights = arms @ up
    arms -= heights[:, None] * up
    radii = np.linalg.norm(arms, axis=1)
    if radii.mean() <= 1e-9 * (1 + np.linalg.norm(centre)):  # 0, up to the rounding of the positions
        raise InputError("cameras: expected cameras around the scene, found all of them in one place")
    east = arms[np.argmax(radii)] / radii.max()
    north = np.cross(up, east)
    angles = np.arctan2(arms @ north, arms @ east)

    ordered = np.sort(angles)
    gaps = np.diff(ordered, append=ordered[0] + 2 * math.pi)
    turn = 2 * math.pi * np.arange(frames) / frames
    if gaps.max() < FULL_CIRCLE_GAP:
        path = angles[0] + turn
    else:
        start = ordered[(int(np.argmax(gaps)) + 1) % len(ordered)]
        arc = 2 * math.pi - gaps.max()
        path = start + arc / 2 * (1 - np.cos(turn))

    first = cameras[0]
    fx = min(first.fx * width / first.width, first.fy * height / first.height)
    rim = radii.mean() * (np.cos(path)[:, None] * east + np.sin(path)[:, None] * north)
    return [Camera.look_at(centre + arm + heights.mean() * up, centre, up, fx, width, height) for arm in rim]


def around(camera: Camera, focus: Array, up: Array, frames: int) -> list[Camera]:
    """Turn a camera once around an axis through a point, for a video that loops.

    Parameters
    ----------
    camera : Camera
        The first of the result.
    focus, up : (3,)
        Point and direction of the axis.
    frames : int
        Number of cameras, at least 1.
    """
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_rotvec(2 * math.pi * np.arange(frames)[:, None] / frames * up).as_matrix()
    result = []
    for turn in turns:
        viewmat = np.eye(4)
        viewmat[:3, :3] = camera.viewmat[:3, :3] @ turn.T
        viewmat[:3, 3] = -viewmat[:3, :3] @ (focus + turn @ (camera.position - focus))
        result.append(replace(camera, viewmat=viewmat))
    return result


def through(cameras: list[Camera], frames: int, *, closed: bool = False) -> list[Camera]:
    """Cameras on a smooth path through others, at equal intervals of time.

    Parameters
    ----------
    cameras : list of Camera
        At least two pinholes. Consecutive ones that are equal count as one.
    frames : int
        Number of cameras on the path, at least 1. The first is that of `cameras`, and so is the last unless the path
        is closed.
    closed : bool
        The path returns to the first camera.

    Raises
    ------
    InputError
        If there are fewer than two different cameras, or no frame.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    stops = [b for a, b in zip([None, *cameras], cameras, strict=False) if a is None or not _equal(a, b)]
    if closed:
        stops = [*stops, stops[0]] if stops and not _equal(stops[0], stops[-1]) else stops
    if len(stops) < 2 or frames < 1:
        raise InputError(f"path: expected two different cameras and a frame, found {len(stops)} and {frames}")
    times = np.arange(len(stops), dtype=np.float64)
    at = np.linspace(0, times[-1], frames, endpoint=not closed)
    positions = CubicSpline(
        times, [c.position for c in stops], bc_type="periodic" if closed and len(stops) > 2 else "not-a-knot"
    )(at)
    turned = RotationSpline(times, Rotation.from_matrix([c.viewmat[:3, :3] for c in stops]))(at).as_matrix()
    focals = np.interp(at, times, [c.fx for c in stops]) / stops[0].fx
    result = []
    for position, rotation, zoom in zip(positions, turned, focals, strict=True):
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ position
        result.append(replace(stops[0], viewmat=viewmat, fx=stops[0].fx * zoom, fy=stops[0].fy * zoom))
    return result


def _equal(a: Camera, b: Camera) -> bool:
    return bool(np.array_equal(a.viewmat, b.viewmat) and a.fx == b.fx)


class Viewpoint(NamedTuple):
    """The first view of a scene: camera, focus (3,) around which it turns, and up direction (3,), a unit vector."""

    camera: Camera
    focus: Array
    up: Array


def first_photo(cameras: list[Camera]) -> Viewpoint:
    """Viewpoint of the first camera of a scene.

    Raises
    ------
    InputError
        If there is no camera.
    """
    return Viewpoint(cameras[0], focus_point(cameras), _up(cameras))


def overview(gaussians: Gaussians) -> Viewpoint:
    """Viewpoint for a scene without cameras: in front of it and a little above.

    The field of view across the shorter edge of the picture is `FIELD_OF_VIEW`. Up is -y, as in most scenes of
    photogrammetry.
    """
    centre, radius = bounds(gaussians)
    up = np.array([0.0, -1.0, 0.0])
    eye = centre + OVERVIEW_RADII * radius * (math.sin(OVERVIEW_HEIGHT) * up - [0, 0, math.cos(OVERVIEW_HEIGHT)])
    fx = OVERVIEW_SIZE[1] / 2 / math.tan(FIELD_OF_VIEW / 2)
    return Viewpoint(Camera.look_at(eye, centre, up, fx, *OVERVIEW_SIZE), centre, up)


def _up(cameras: list[Camera]) -> Array:
    """Mean of the cameras' up vectors, a unit vector."""
    ups = np.array([-camera.viewmat[1, :3] for camera in cameras])
    up = ups.mean(axis=0)
    up = up if np.linalg.norm(up) > 1e-3 else ups[0]  # the up vectors cancel: half of the cameras are upside down
    return np.asarray(up / np.linalg.norm(up))
