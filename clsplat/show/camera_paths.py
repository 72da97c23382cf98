"""Camera paths: an orbit around what the training cameras look at; viewpoints for a scene without cameras."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, focus_point
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.pruning.viewpoints import FIELD_OF_VIEW, bounds

Array = NDArray[Any]

FULL_CIRCLE_GAP = math.pi / 2
"""Where the photos leave out more of the circle than this, in radians, the path swings over the rest instead of
closing: Gaussians seen from where no photo was taken look arbitrary."""

OVERVIEW_HEIGHT = math.radians(20)
"""Of `overview` above the horizon, in radians: as a person looks at a table."""

OVERVIEW_RADII = 3.5
"""Distance of `overview` from the scene's centre, in its radii: half of the weight is within one, two are seen."""

OVERVIEW_SIZE = (1280, 720)
"""Of `overview`, in pixels."""


def orbit(cameras: list[Camera], frames: int, width: int, height: int) -> list[Camera]:
    """Cameras on a horizontal circle around the scene's focus, for a video that loops.

    The centre is `focus_point`, the axis the mean of the cameras' up vectors, radius and height above the centre
    are the cameras' means. Where the cameras leave a quarter of the circle or more without a photo, the path
    swings smoothly over the arc they cover, there and back.

    Parameters
    ----------
    cameras : list of Camera
        The training cameras; the first one lends its field of view, so that the whole of its image is seen.
    frames : int
        Number of cameras on the path, at least 1.
    width, height : int
        Size of the frames in pixels.

    Returns
    -------
    list of Camera
        In the coordinates of `cameras`.

    Raises
    ------
    InputError
        If there is no camera, no frame, or no camera stands beside what they look at: a panorama from one place.
    """
    centre = focus_point(cameras)
    if frames < 1:
        raise InputError(f"frames: expected at least 1, found {frames}")
    up = _up(cameras)

    arms = np.array([camera.position for camera in cameras]) - centre
    heights = arms @ up
    arms -= heights[:, None] * up
    radii = np.linalg.norm(arms, axis=1)
    if radii.mean() <= 1e-9 * (1 + np.linalg.norm(centre)):  # 0 but for the rounding of the positions
        raise InputError("cameras: expected cameras around what they look at, found none beside it")
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
    fx = first.fx * min(width / first.width, height / first.height)
    rim = radii.mean() * (np.cos(path)[:, None] * east + np.sin(path)[:, None] * north)
    return [Camera.look_at(centre + arm + heights.mean() * up, centre, up, fx, width, height) for arm in rim]


class Viewpoint(NamedTuple):
    """Where a scene is first looked at from: a camera; the focus (3,), what there is to look at; and what is up (3,),
    a unit vector."""

    camera: Camera
    focus: Array
    up: Array


def first_photo(cameras: list[Camera]) -> Viewpoint:
    """The first of a scene's cameras.

    Raises
    ------
    InputError
        If there is none.
    """
    return Viewpoint(cameras[0], focus_point(cameras), _up(cameras))


def overview(gaussians: Gaussians) -> Viewpoint:
    """A first look at a scene of which no cameras are known: from before it and a little above, `FIELD_OF_VIEW`
    across the shorter edge of the picture. Up is -y, as in most scenes of photogrammetry."""
    centre, radius = bounds(gaussians)
    up = np.array([0.0, -1.0, 0.0])
    eye = centre + OVERVIEW_RADII * radius * (math.sin(OVERVIEW_HEIGHT) * up - [0, 0, math.cos(OVERVIEW_HEIGHT)])
    fx = OVERVIEW_SIZE[1] / 2 / math.tan(FIELD_OF_VIEW / 2)
    return Viewpoint(Camera.look_at(eye, centre, up, fx, *OVERVIEW_SIZE), centre, up)


def _up(cameras: list[Camera]) -> Array:
    """The mean of the directions to the photos' upper edges, a unit vector."""
    ups = np.array([-camera.viewmat[1, :3] for camera in cameras])
    up = ups.mean(axis=0)
    up = up if np.linalg.norm(up) > 1e-3 else ups[0]  # as many upside down as not: the first decides
    return np.asarray(up / np.linalg.norm(up))
