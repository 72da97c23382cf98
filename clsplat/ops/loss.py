"""Launch of the stage loss (cl/loss.cl)."""

from typing import Any

import numpy as np
from pyopencl.array import Array

from clsplat.constants import SSIM_C1, SSIM_C2, SSIM_TAPS
from clsplat.device import Device

SEGMENT = 16  # pixels per work-item, as in the kernel
RADIUS = len(SSIM_TAPS) // 2


def l1_ssim(
    device: Device, image: Array, photo: Array, ssim_weight: float, mask: Array | None = None
) -> tuple[float, Array]:
    """Training loss and its gradient.

    Parameters
    ----------
    image : (H, W, 3) real
    photo : (H, W, 3) uint8
    ssim_weight : float
        lambda of (1 - lambda) L1 + lambda (1 - SSIM).
    mask : (H, W) uint8, optional
        1 where pixels count; image and photo are taken as black elsewhere.

    Returns
    -------
    loss : float
    v_image : (H, W, 3) real
    """
    height, width, _ = image.shape
    segments = -(-width // SEGMENT)
    defines = {
        "SSIM_C1": SSIM_C1,
        "SSIM_C2": SSIM_C2,
        "SSIM_TAPS": ",".join(map(repr, SSIM_TAPS)),
        "RADIUS": RADIUS,
    }
    plane = 3 * (height + 2 * RADIUS) * (segments + 2) * SEGMENT
    # The planes' margins stand for the window's zero padding: no kernel writes them, for this size of image.
    x, y, moments, derivatives, blurred = (
        device.scratch(f"loss {what}", planes * plane, (width, height))
        for what, planes in (("image", 1), ("photo", 1), ("moments", 5), ("derivatives", 3), ("blurred", 3))
    )
    ssim_sums, l1_sums = (device.empty("loss sums", (3, height, segments)) for _ in range(2))
    v_image = device.empty("v_image", (height, width, 3))
    masked = [int(mask is not None), photo if mask is None else mask]

    def run(kernel: str, arguments: list[Any], size: tuple[int, ...] = (segments, height, 3)) -> None:
        device.launch("loss", kernel, size, [width, height, *arguments], defines=defines)

    count = 3 * width * height
    weights = [(1 - ssim_weight) / count, ssim_weight / count]
    run("loss_planes", [image, photo, *masked, x, y], (width, height))
    run("loss_blur_rows", [x, y, moments])
    run("loss_ssim", [moments, derivatives, ssim_sums])
    run("loss_blur_rows3", [derivatives, blurred])
    run("loss_grad", [*weights, *masked, x, y, blurred, v_image, l1_sums])
    l1 = float(l1_sums.get().sum(dtype=np.float64)) / count
    ssim = float(ssim_sums.get().sum(dtype=np.float64)) / count
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim), v_image
