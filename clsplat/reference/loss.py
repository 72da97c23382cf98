"""Twin of the stage loss: L1 and SSIM with zero padding (Wang et al. 2004), and their gradient."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SSIM_C1, SSIM_C2, SSIM_TAPS

Array = NDArray[np.float64]


def blur(image: Array) -> Array:
    """Gaussian window over the first two axes of (H, W, C), with zero padding. It is its own adjoint."""
    radius = len(SSIM_TAPS) // 2
    for axis in (0, 1):
        n = image.shape[axis]
        pad = [(radius, radius) if a == axis else (0, 0) for a in range(image.ndim)]
        padded = np.pad(image, pad)
        image = sum((w * padded.take(range(k, k + n), axis=axis) for k, w in enumerate(SSIM_TAPS)), np.zeros(()))
    return image


def l1_ssim(
    image: NDArray[Any], photo: NDArray[np.uint8], ssim_weight: float, mask: NDArray[np.uint8] | None = None
) -> tuple[float, Array]:
    """Training loss and its gradient. Arguments and result as for `clsplat.ops.l1_ssim`."""
    weight = np.ones((*image.shape[:2], 1)) if mask is None else mask[:, :, None].astype(np.float64)
    x, y = weight * image, weight * photo / 255
    mx, my, exx, eyy, exy = blur(x), blur(y), blur(x * x), blur(y * y), blur(x * y)
    a1, a2 = 2 * mx * my + SSIM_C1, 2 * (exy - mx * my) + SSIM_C2
    b1, b2 = mx**2 + my**2 + SSIM_C1, exx - mx**2 + eyy - my**2 + SSIM_C2
    ssim = a1 * a2 / (b1 * b2)
    by_mx = 2 * my * (a2 - a1) / (b1 * b2) - 2 * mx * ssim * (1 / b1 - 1 / b2)
    v_ssim = blur(by_mx) + 2 * x * blur(-ssim / b2) + y * blur(2 * a1 / (b1 * b2))
    loss = (1 - ssim_weight) * np.abs(x - y).mean() + ssim_weight * (1 - ssim.mean())
    v_image = weight * ((1 - ssim_weight) * np.sign(x - y) - ssim_weight * v_ssim) / x.size
    return float(loss), v_image
