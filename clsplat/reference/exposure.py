"""Twin of the stage exposure."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def exposure_fwd(image: Array, affine: Array, photo: Array) -> Array:
    """Map the colours of an image. Arguments and result as for `clsplat.ops.exposure_fwd`."""
    y = image @ affine[:, :3].T + affine[:, 3]
    return np.where(_beyond(y, photo), np.clip(y, 0, 1), y)


def _beyond(y: Array, photo: Array) -> Array:
    """Where mapped colours `y` lie beyond the limit at which the camera has clipped the photo."""
    return ((photo == 255) & (y > 1)) | ((photo == 0) & (y < 0))


def exposure_bwd(image: Array, affine: Array, photo: Array, v_image: Array) -> Array:
    """Gradients of `exposure_fwd`. Arguments and result as for `clsplat.ops.exposure_bwd`."""
    clipped = _beyond(image @ affine[:, :3].T + affine[:, 3], photo)
    v = np.where(clipped, 0, v_image).reshape(-1, 3).astype(np.float64)
    x = image.reshape(-1, 3)
    v_affine = np.concatenate([v.T @ x, v.sum(axis=0)[:, None]], axis=1)
    v_image[:] = (v @ affine[:, :3]).reshape(v_image.shape)
    return v_affine
