"""COLMAP's camera models, through pycolmap: fisheyes as they are, other distorted cameras made pinholes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Not for its names: a Pillow that is loaded after pycolmap 4.2.1 takes over some of the zlib inside it and crashes
# when it writes a PNG. Loaded first, it keeps its own.
import clsplat.dataset.photos  # noqa: F401
from clsplat.errors import InputError


@dataclass(frozen=True)
class Intrinsics:
    """A camera as COLMAP describes it, without its pose.

    Parameters
    ----------
    model : str
        Name of a COLMAP camera model.
    params : tuple of float
        Its parameters in COLMAP's order, focal lengths and principal point in pixels.
    width, height : int
        Image size in pixels.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int


# How the parameters of COLMAP's fisheyes whose radius is a polynomial of the angle become OPENCV_FISHEYE's.
_FISHEYES: dict[str, Callable[..., tuple[float, ...]]] = {
    "OPENCV_FISHEYE": lambda *params: params,
    "FISHEYE": lambda fx, fy, cx, cy: (fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0),
    "SIMPLE_FISHEYE": lambda f, cx, cy: (f, f, cx, cy, 0.0, 0.0, 0.0, 0.0),
    "SIMPLE_RADIAL_FISHEYE": lambda f, cx, cy, k: (f, f, cx, cy, k, 0.0, 0.0, 0.0),
    "RADIAL_FISHEYE": lambda f, cx, cy, k1, k2: (f, f, cx, cy, k1, k2, 0.0, 0.0),
}


def rendered(intrinsics: Intrinsics) -> Intrinsics:
    """The camera that is rendered in a photo's place.

    Returns
    -------
    Intrinsics
        Of model OPENCV_FISHEYE and the photo's size where the model is a fisheye with a polynomial of the angle:
        kernels project to it, and nothing of the photo is lost. Otherwise as `undistorted`, with its errors.
    """
    if intrinsics.model in _FISHEYES:
        _camera(intrinsics)  # checks the number of parameters
        return replace(intrinsics, model="OPENCV_FISHEYE", params=_FISHEYES[intrinsics.model](*intrinsics.params))
    return undistorted(intrinsics)


def undistorted(intrinsics: Intrinsics) -> Intrinsics:
    """The pinhole camera that COLMAP's undistorter makes of a camera.

    Parameters
    ----------
    intrinsics : Intrinsics
        Any perspective or fisheye model.

    Returns
    -------
    Intrinsics
        Of model PINHOLE. Where the camera is one already, its size stays; otherwise it sees the largest centred
        rectangle that holds no pixel from outside the photo (COLMAP's blank_pixels = 0).

    Raises
    ------
    InputError
        If the model does not exist, has another number of parameters, or cannot become a pinhole.
    """
    if intrinsics.model == "PINHOLE":
        return intrinsics
    if intrinsics.model == "SIMPLE_PINHOLE":
        f, cx, cy = intrinsics.params
        return replace(intrinsics, model="PINHOLE", params=(f, f, cx, cy))
    import pycolmap

    camera = _camera(intrinsics)
    if is_pinhole(intrinsics):
        params = (camera.focal_length_x, camera.focal_length_y, camera.principal_point_x, camera.principal_point_y)
        return replace(intrinsics, model="PINHOLE", params=params)
    if not camera.is_perspective():
        raise InputError(
            f"camera model {intrinsics.model}: expected a perspective or fisheye camera, which can become a pinhole"
        )
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(blank_pixels=0.0), camera)
    return Intrinsics("PINHOLE", tuple(map(float, pinhole.params)), pinhole.width, pinhole.height)


def is_pinhole(intrinsics: Intrinsics) -> bool:
    """Whether the camera maps straight lines to straight lines: no distortion coefficient is set.

    Fisheye models are none even with all coefficients zero, since their radius grows with the angle.
    """
    if intrinsics.model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return True
    camera = _camera(intrinsics)
    return bool(camera.is_perspective_pinhole() and camera.is_undistorted())


def project(intrinsics: Intrinsics, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where points appear in the distorted photo.

    Parameters
    ----------
    intrinsics : Intrinsics
        Of any model.
    points : (N, 3) float64
        In camera coordinates (x right, y down, z forward).

    Returns
    -------
    (N, 2) float64
        In pixels, from the upper left corner of the photo; NaN behind the camera.
    """
    pixels: NDArray[np.float64] = _camera(intrinsics).img_from_cam(points)
    return pixels


def _camera(intrinsics: Intrinsics) -> Any:
    import pycolmap

    try:
        camera = pycolmap.Camera.create_from_model_name(1, intrinsics.model, 1.0, intrinsics.width, intrinsics.height)
    except ValueError as error:
        raise InputError(
            f"camera model: expected one of {', '.join(camera_models())}, found {intrinsics.model!r}"
        ) from error
    if len(camera.params) != len(intrinsics.params):
        raise InputError(
            f"camera model {intrinsics.model}: expected {len(camera.params)} parameters ({camera.params_info}), "
            f"found {len(intrinsics.params)}"
        )
    camera.params = intrinsics.params
    return camera


def camera_models() -> list[str]:
    """Camera models that can become a pinhole."""
    import pycolmap

    return [name for name in pycolmap.CameraModelId.__members__ if name not in ("INVALID", "EQUIRECTANGULAR")]
