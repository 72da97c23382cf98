"""Conversions between cameras and the viewer's browser windows."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.reference.project import rotations


def client_camera(wxyz: Any, position: Any, fov: float, width: int, height: int) -> Camera:
    """Camera of a browser window.

    Parameters
    ----------
    wxyz, position : (4,), (3,)
        Orientation and position, camera to world with OpenCV axes, as viser reports them.
    fov : float
        Vertical field of view, radians.
    width, height : int
        Size of the window, px.
    """
    viewmat = np.eye(4)
    quat = np.asarray(wxyz, dtype=np.float64)
    viewmat[:3, :3] = rotations(quat / np.linalg.norm(quat)).T
    viewmat[:3, 3] = -viewmat[:3, :3] @ np.asarray(position, dtype=np.float64)
    f = height / 2 / math.tan(fov / 2)
    return Camera(viewmat, f, f, width / 2, height / 2, width, height)


def wxyz_of(camera: Camera) -> NDArray[np.float64]:
    """Orientation of a camera as viser expects it: a quaternion (4,), camera to world."""
    from scipy.spatial.transform import Rotation

    return np.asarray(np.roll(Rotation.from_matrix(camera.viewmat[:3, :3].T).as_quat(), 1))


def whole_view(camera: Camera, aspect: float) -> float:
    """Vertical field of view, radians, at which a window shows the whole image of a camera.

    `aspect` is the window's width over its height.
    """
    return 2 * math.atan(max(camera.height / camera.fy, camera.width / camera.fx / aspect) / 2)
