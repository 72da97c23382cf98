"""Launch of the stage loss (cl/loss.cl)."""

from typing import Any

from pyopencl.array import Array

from clsplat.constants import SSIM_C1, SSIM_C2, SSIM_TAPS
from clsplat.device import GROUP, Device

RADIUS = len(SSIM_TAPS) // 2

# What a work-item owns: VECTORS * LANES values of BAND rows. On CPUs as fast as the best of 16 to 128 values and 32
# to 128 rows, and 168 work-items at 640x480; on GPUs one value, and 60 000 work-items.
CPU_SHAPE = {"LANES": 16, "VECTORS": 6, "BAND": 64}
GPU_SHAPE = {"LANES": 1, "VECTORS": 1, "BAND": 16}


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
    shape, group = (CPU_SHAPE, 1) if device.is_cpu else (GPU_SHAPE, GROUP)
    defines = shape | {
        "SSIM_C1": SSIM_C1,
        "SSIM_C2": SSIM_C2,
        "SSIM_TAPS": ",".join(map(repr, SSIM_TAPS)),
        "RADIUS": RADIUS,
        "GROUP": GROUP,
    }
    lanes, strip = shape["LANES"], shape["LANES"] * shape["VECTORS"]
    margin = -(-3 * RADIUS // lanes) * lanes
    groups = -(-(3 * width + 2 * margin) // (strip * group))
    bands = -(-height // shape["BAND"])
    derivatives = device.empty("derivatives of SSIM", (height, 3, groups * group * strip))
    parts, loss = device.empty("parts of the loss", bands * groups), device.empty("loss", 1)
    v_image = device.empty("v_image", (height, width, 3))

    def run(kernel: str, arguments: list[Any]) -> None:
        device.launch("loss", kernel, (groups * group, bands), arguments, defines=defines, group=(group, 1))

    count = 3 * width * height
    weights = [(1 - ssim_weight) / count, ssim_weight / count]
    pair = [image, photo, int(mask is not None), photo if mask is None else mask]
    run("loss_ssim", [width, height, *weights, *pair, derivatives, parts])
    device.launch("loss", "loss_sum", (GROUP,), [bands * groups, parts, loss], defines=defines, group=(GROUP,))
    run("loss_grad", [width, height, *weights, *pair, derivatives, v_image])
    return float(loss.get()[0]), v_image
