"""Conversions between cameras and the viewer's browser windows."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.reference.project import rotations
from clsplat.show.camera_paths import Viewpoint

Array = NDArray[np.float64]

LARGEST_EDGE = 16384
"""Largest edge of a window, px: the limit of most graphics cards for the canvas that shows the scene."""

LARGEST_FRAME = 3840 * 2160
"""Largest number of pixels of a frame: a whole 4K screen. In a larger window, the browser enlarges the frame. This
bounds the memory of a frame, which is proportional to its pixels."""


def client_camera(wxyz: Any, position: Any, fov: float, width: int, height: int) -> Camera:
    """Camera of a browser window, with `LARGEST_FRAME` pixels at most.

    Parameters
    ----------
    wxyz, position : (4,), (3,)
        Orientation and position, camera to world with OpenCV axes, as viser reports them.
    fov : float
        Vertical field of view, radians.
    width, height : int
        Size of the window, px.

    Raises
    ------
    InputError
        If a value is not finite as float32, the quaternion is zero, the field of view is not between 0 and pi, or an
        edge is not between 1 and `LARGEST_EDGE`.
    """
    values = np.array([*wxyz, *position, fov], dtype=np.float64)
    if not (np.abs(values) <= np.finfo(np.float32).max).all():
        raise InputError(f"camera: expected a finite pose and field of view, as float32, found {values.tolist()}")
    quat, position, norm = values[:4], values[4:7], np.linalg.norm(values[:4])
    if norm == 0 or not 0 < fov / 2 < math.pi / 2:
        raise InputError(
            f"camera: expected a rotation and a field of view between 0 and pi, found the quaternion {quat.tolist()} "
            f"and {fov}"
        )
    if not (1 <= width <= LARGEST_EDGE and 1 <= height <= LARGEST_EDGE):
        raise InputError(f"window: expected edges between 1 and {LARGEST_EDGE} px, found {width}x{height}")
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotations(quat / norm).T
    viewmat[:3, 3] = -viewmat[:3, :3] @ position
    f = height / 2 / math.tan(fov / 2)
    camera = Camera(viewmat, f, f, width / 2, height / 2, width, height)
    scale = math.sqrt(LARGEST_FRAME / (width * height))
    return camera if scale >= 1 else camera.resized(*(max(1, int(scale * edge)) for edge in (width, height)))


def wxyz_of(camera: Camera) -> Array:
    """Orientation of a camera as viser expects it: a quaternion (4,), camera to world."""
    from scipy.spatial.transform import Rotation

    return np.asarray(np.roll(Rotation.from_matrix(camera.viewmat[:3, :3].T).as_quat(), 1))


def whole_view(camera: Camera, aspect: float) -> float:
    """Vertical field of view, radians, at which a window shows the whole image of a camera.

    `aspect` is the window's width over its height.
    """
    return 2 * math.atan(max(camera.height / camera.fy, camera.width / camera.fx / aspect) / 2)


def target_of(camera: Camera, focus: Array) -> Array:
    """Point of a camera's axis nearest to the focus, mirrored to the front if it is behind the camera, (3,)."""
    axis = camera.viewmat[2, :3]
    return np.asarray(camera.position + max(abs(float((focus - camera.position) @ axis)), 1e-3) * axis)


class Pose(NamedTuple):
    """View of a browser: position, target around which the mouse turns it and up vector, (3,); vertical field of
    view, radians."""

    position: Array
    target: Array
    up: Array
    fov: float


def first_pose(start: Viewpoint) -> Pose:
    """View of a browser that shows the whole image of a viewpoint's camera."""
    camera, right = start.camera, start.camera.viewmat[0, :3]
    # Without its component to the right, the up vector reproduces the photo and tilts the mouse's axis least.
    up = start.up - (start.up @ right) * right
    return Pose(camera.position, target_of(camera, start.focus), up, whole_view(camera, camera.width / camera.height))
