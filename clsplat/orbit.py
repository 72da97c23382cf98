"""Camera paths: an orbit around what the training cameras look at."""

import math

import numpy as np

from clsplat.camera import Camera, focus_point
from clsplat.errors import InputError

FULL_CIRCLE_GAP = math.pi / 2
"""Where the photos leave out more of the circle than this, in radians, the path swings over the rest instead of
closing: Gaussians seen from where no photo was taken look arbitrary."""


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
    ups = np.array([-camera.viewmat[1, :3] for camera in cameras])
    up = ups.mean(axis=0)
    up = up if np.linalg.norm(up) > 1e-3 else ups[0]  # as many upside down as not: the first decides
    up /= np.linalg.norm(up)

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
