"""COLMAP's camera models, through pycolmap: fisheyes are kept, other distorted cameras become pinholes."""

import signal
import sys
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Imports Pillow before pycolmap. Loaded after pycolmap 4.2.1, Pillow uses parts of the zlib inside pycolmap and
# crashes when it writes a PNG.
import clsplat.dataset.photos  # noqa: F401
from clsplat.errors import InputError

TRACED = (signal.SIGTERM, signal.SIGABRT, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV)
"""Signals after which COLMAP prints a stack trace."""


@dataclass(frozen=True)
class Intrinsics:
    """The intrinsics of a camera, as COLMAP defines them.

    Parameters
    ----------
    model : str
        Name of a COLMAP camera model.
    params : tuple of float
        Parameters in COLMAP's order; focal lengths and principal point in pixels.
    width, height : int
        Image size in pixels.
    """

    model: str
    params: tuple[float, ...]
    width: int
    height: int


# Conversions of parameters to OPENCV_FISHEYE, for COLMAP's fisheyes whose radius is a polynomial of the angle.
_FISHEYES: dict[str, Callable[..., tuple[float, ...]]] = {
    "OPENCV_FISHEYE": lambda *params: params,
    "FISHEYE": lambda fx, fy, cx, cy: (fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0),
    "SIMPLE_FISHEYE": lambda f, cx, cy: (f, f, cx, cy, 0.0, 0.0, 0.0, 0.0),
    "SIMPLE_RADIAL_FISHEYE": lambda f, cx, cy, k: (f, f, cx, cy, k, 0.0, 0.0, 0.0),
    "RADIAL_FISHEYE": lambda f, cx, cy, k1, k2: (f, f, cx, cy, k1, k2, 0.0, 0.0),
}


def rendered(intrinsics: Intrinsics) -> Intrinsics:
    """Choose the camera with which a photo is rendered.

    Returns
    -------
    Intrinsics
        For fisheyes whose radius is a polynomial of the angle: model OPENCV_FISHEYE at the photo's size. The kernels
        project to this model, so that no part of the photo is lost. For other models: `undistorted`.

    Raises
    ------
    InputError
        As `undistorted`.
    """
    if intrinsics.model in _FISHEYES:
        _camera(intrinsics)  # checks the number of parameters
        return replace(intrinsics, model="OPENCV_FISHEYE", params=_FISHEYES[intrinsics.model](*intrinsics.params))
    return undistorted(intrinsics)


def undistorted(intrinsics: Intrinsics) -> Intrinsics:
    """Compute the pinhole camera of an undistorted photo, as COLMAP's undistorter does.

    Parameters
    ----------
    intrinsics : Intrinsics
        Camera of any perspective or fisheye model.

    Returns
    -------
    Intrinsics
        Camera of model PINHOLE. A camera without distortion keeps its size. Otherwise the image is the largest
        centred rectangle that contains no pixel from outside the photo (COLMAP's blank_pixels = 0).

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
    pycolmap = _colmap()
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
    """Whether the camera maps straight lines to straight lines: all distortion coefficients are zero.

    Fisheye models are never pinholes, even with zero coefficients, since their radius grows with the angle.
    """
    if intrinsics.model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return True
    camera = _camera(intrinsics)
    return bool(camera.is_perspective_pinhole() and camera.is_undistorted())


def project(intrinsics: Intrinsics, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points to the distorted photo.

    Parameters
    ----------
    intrinsics : Intrinsics
        Camera of any model.
    points : (N, 3) float64
        Points in camera coordinates (x right, y down, z forward).

    Returns
    -------
    (N, 2) float64
        Positions in pixels, from the upper left corner of the photo; NaN for points behind the camera.
    """
    pixels: NDArray[np.float64] = _camera(intrinsics).img_from_cam(points)
    return pixels


def _camera(intrinsics: Intrinsics) -> Any:
    try:
        camera = _colmap().Camera.create_from_model_name(
            1, intrinsics.model, 1.0, intrinsics.width, intrinsics.height
        )
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
    """List the COLMAP camera models that can become a pinhole."""
    return [name for name in _colmap().CameraModelId.__members__ if name not in ("INVALID", "EQUIRECTANGULAR")]


def import_models(lenses: Iterable[Intrinsics]) -> None:
    """Import pycolmap in this thread if one of the lenses may need it: only the main thread can handle signals."""
    if not {lens.model for lens in lenses} <= {"PINHOLE", "SIMPLE_PINHOLE"}:
        _colmap()


def handle_signals() -> None:
    """Handle signals as Python was told to: pycolmap has replaced the handlers on import without its knowledge.

    Only the main thread can do that; in others, nothing happens.
    """
    if threading.current_thread() is threading.main_thread():
        for number in TRACED:
            signal.signal(number, signal.getsignal(number))


def _colmap() -> Any:
    """The module pycolmap, imported without an effect on signals."""
    first = "pycolmap" not in sys.modules
    import pycolmap

    if first:
        handle_signals()
    return pycolmap
