"""Twin of the stage disparity."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.stages import AnyGrads, AnySplats

Array = NDArray[Any]


def _inverse(depths: Array) -> Array:
    return np.divide(1, depths, out=np.zeros_like(depths), where=depths > 0)


def disparity_fwd(splats: AnySplats) -> None:
    """Replace depths by inverse depths, in place. Arguments as for `clsplat.ops.disparity_fwd`."""
    splats.colors[:, 3] = _inverse(splats.depths)


def disparity_bwd(splats: AnySplats, v_splats: AnyGrads) -> None:
    """Gradients of `disparity_fwd`, in place. Arguments as for `clsplat.ops.disparity_bwd`."""
    v_splats.colors[:, 3] *= -(_inverse(splats.depths) ** 2)


def disparity_loss(image: Array, target: Array, weight: float) -> tuple[float, Array]:
    """Compare inverse depths. Arguments and result as for `clsplat.ops.disparity_loss`."""
    off = np.where(target > 0, image[:, :, 3] - target, 0)
    return weight * float(np.abs(off).sum()), image[:, :, :3].copy()


def disparity_grad(image: Array, target: Array, weight: float, v_rgb: Array) -> Array:
    """Gradients of `disparity_loss`. Arguments and result as for `clsplat.ops.disparity_grad`."""
    off = np.where(target > 0, image[:, :, 3] - target, 0)
    return np.concatenate([v_rgb, weight * np.sign(off)[:, :, None]], axis=2)
