"""Positions in the file of an undistorted photo's pixels, and their values."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.dataset.lenses import Intrinsics, project, undistorted
from clsplat.errors import InputError


def squares_of(pixels: NDArray[Any], camera: Camera, edge: int) -> NDArray[Any]:
    """The pixels in squares of an edge, of which the camera sees one as a pixel: (h, edge, w, edge, ...)."""
    inside = pixels[: camera.height * edge, : camera.width * edge]
    return inside.reshape(camera.height, edge, camera.width, edge, *pixels.shape[2:])


# Photos of one camera share an entry. The small size bounds the memory if every photo has its own camera.
@lru_cache(maxsize=2)
def lens_positions(intrinsics: Intrinsics, size: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Compute where the pixels of an undistorted image lie in the distorted photo.

    Parameters
    ----------
    intrinsics : Intrinsics
        The distorted camera.
    size : (int, int)
        Width and height of the photo, px.
    shape : (int, int)
        Height and width of the undistorted image, in the same pixels.

    Returns
    -------
    (2, H, W) float32
        Row and column indices, which count from pixel centres.

    Raises
    ------
    InputError
        If a pixel lies outside the photo.
    """
    sx, sy = size[0] / intrinsics.width, size[1] / intrinsics.height
    fx, fy, cx, cy = undistorted(intrinsics).params
    positions = np.empty((2, *shape), dtype=np.float32)
    with np.errstate(all="ignore"):  # positions that overflow lie outside, which is checked below
        x = ((np.arange(shape[1]) + 0.5) / sx - cx) / fx
        y = ((np.arange(shape[0]) + 0.5) / sy - cy) / fy
        for row in range(shape[0]):
            rays = np.stack([x, np.full_like(x, y[row]), np.ones_like(x)], axis=-1)
            positions[1, row], positions[0, row] = (project(intrinsics, rays) * (sx, sy)).T
    # COLMAP fits the undistorted camera to the photo's border only. Rounding accounts for half a pixel; a whole pixel
    # outside is an error.
    inside = (positions > -1) & (positions < np.array(size[::-1]).reshape(2, 1, 1) + 1)
    if not inside.all():
        raise InputError(
            f"camera model {intrinsics.model}: expected a distortion that can be undone over the whole photo, found "
            f"parameters {intrinsics.params}"
        )
    return positions - np.float32(0.5)


def resampled(channel: NDArray[Any], positions: NDArray[np.float32], order: int) -> NDArray[Any]:
    """Values of a channel (H, W) at positions (2, h, w), interpolated by splines of an order."""
    from scipy.ndimage import map_coordinates

    values: NDArray[Any] = map_coordinates(channel, positions, order=order, mode="nearest")
    return values
