"""Twin of the stage exposure."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def exposure_fwd(image: Array, affine: Array) -> Array:
    """Map an image's colours; arguments and result as `clsplat.ops.exposure_fwd`."""
    return image @ affine[:, :3].T + affine[:, 3]


def exposure_bwd(image: Array, affine: Array, v_image: Array) -> Array:
    """Gradients of `exposure_fwd`; arguments and result as `clsplat.ops.exposure_bwd`."""
    v = v_image.reshape(-1, 3).astype(np.float64)
    x = image.reshape(-1, 3)
    v_affine = np.concatenate([v.T @ x, v.sum(axis=0)[:, None]], axis=1)
    v_image[:] = (v @ affine[:, :3]).reshape(v_image.shape)
    return v_affine
