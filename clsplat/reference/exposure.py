"""Twin of the stage exposure."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def exposure_fwd(image: Array, affine: Array, photo: Array) -> Array:
    """Map the colours of an image. Arguments and result as for `clsplat.ops.exposure_fwd`."""
    y = _mapped(image, affine)
    return np.where(_beyond(y, photo), np.clip(y, 0, 1), y)


def squared_radius(height: int, width: int) -> Array:
    """Squared distances of pixels from the middle of the image, (H, W, 1); 1 in its corners."""
    y, x = (2 * np.arange(n) + 1.0 - n for n in (height, width))
    return np.asarray((x**2 + y[:, None] ** 2) / (height**2 + width**2))[:, :, None]


def _mapped(image: Array, affine: Array) -> Array:
    y = image @ affine[:, :3].T + affine[:, 3]
    if affine.shape[1] == 6:
        y = y + affine[:, 4] * image * (1 - image) + affine[:, 5] * squared_radius(*image.shape[:2]) * image
    return y


def _beyond(y: Array, photo: Array) -> Array:
    """Mask of the mapped colours `y` beyond the limit at which the camera has clipped the photo."""
    return ((photo == 255) & (y > 1)) | ((photo == 0) & (y < 0))


def exposure_bwd(image: Array, affine: Array, photo: Array, v_image: Array) -> Array:
    """Gradients of `exposure_fwd`. Arguments and result as for `clsplat.ops.exposure_bwd`."""
    v_y = np.where(_beyond(_mapped(image, affine), photo), 0, v_image).astype(np.float64)
    v, x = v_y.reshape(-1, 3), image.reshape(-1, 3)
    v_affine = np.concatenate([v.T @ x, v.sum(axis=0)[:, None]], axis=1)
    v_image[:] = (v @ affine[:, :3]).reshape(v_image.shape)
    if affine.shape[1] == 6:
        r2 = squared_radius(*image.shape[:2])
        more = [(v_y * image * (1 - image)).sum(axis=(0, 1)), (v_y * r2 * image).sum(axis=(0, 1))]
        v_affine = np.concatenate([v_affine, np.stack(more, axis=1)], axis=1)
        v_image += v_y * (affine[:, 4] * (1 - 2 * image) + affine[:, 5] * r2)
    return v_affine
