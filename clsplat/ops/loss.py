"""Launch of the stage loss (cl/loss.cl)."""

from pyopencl.array import Array

from clsplat.buffers import Reading
from clsplat.constants import SSIM_C1, SSIM_C2, SSIM_TAPS
from clsplat.device import GROUP, Device

RADIUS = len(SSIM_TAPS) // 2
TAPS = ",".join(map(repr, SSIM_TAPS))

# Number of values per vector, and number of neighbouring vectors per work-item. Long runs repeat fewer values of
# their neighbours; the blurred rows of ten vectors fit in the nearest cache of a CPU. On a GPU, neighbouring
# work-items should access neighbouring values.
CPU_SHAPE = {"LANES": 16, "VECTORS": 10}
GPU_SHAPE = {"LANES": 1, "VECTORS": 1}

# Smallest and largest number of rows per work-item. On a CPU, there are four work-items per core within these limits.
# Rows at the edges of a band are blurred twice along the row.
BAND_MIN, BAND_MAX = 16, 64


def l1_ssim(
    device: Device, image: Array, photo: Array, ssim_weight: float, mask: Array | None = None
) -> tuple[Reading, Array]:
    """Training loss and its gradient.

    Parameters
    ----------
    image : (H, W, 3) real
    photo : (H, W, 3) uint8
    ssim_weight : float
        Weight lambda in (1 - lambda) L1 + lambda (1 - SSIM).
    mask : (H, W) uint8, optional
        1 where pixels count. Elsewhere, image and photo are treated as black.

    Returns
    -------
    loss : Reading
        The host waits for it when it is converted to a number.
    v_image : (H, W, 3) real
    """
    height, width, _ = image.shape
    largest = device.group(GROUP)
    shape, group = (CPU_SHAPE, 1) if device.is_cpu else (GPU_SHAPE, largest)
    defines = shape | {
        "SSIM_C1": SSIM_C1,
        "SSIM_C2": SSIM_C2,
        "SSIM_TAPS": TAPS,
        "RADIUS": RADIUS,
        "GROUP": largest,
    }
    lanes, strip = shape["LANES"], shape["LANES"] * shape["VECTORS"]
    margin = -(-3 * RADIUS // lanes) * lanes
    groups = -(-(3 * width + 2 * margin) // (strip * group))
    band = BAND_MIN
    if device.is_cpu:
        band = min(max(height * groups // (4 * device.cl_device.max_compute_units), BAND_MIN), BAND_MAX)
    bands = -(-height // band)
    derivatives = device.empty("derivatives of SSIM", (height, 3, groups * group * strip))
    parts, loss = device.empty("parts of the loss", bands * groups), device.empty("loss", 1)
    v_image = device.empty("v_image", (height, width, 3))

    count = 3 * width * height
    weights = [(1 - ssim_weight) / count, ssim_weight / count]
    pair = [image, photo, int(mask is not None), photo if mask is None else mask]
    shared = [width, height, band, *weights, *pair, derivatives]
    for kernel, size, local, arguments in (
        ("loss_ssim", (groups * group, bands), (group, 1), [*shared, parts]),
        ("loss_sum", (largest,), (largest,), [bands * groups, parts, loss]),
        ("loss_grad", (groups * group, bands), (group, 1), [*shared, v_image]),
    ):
        device.launch("loss", kernel, size, arguments, defines=defines, group=local)
        if kernel == "loss_sum":
            reading = Reading(loss)
    return reading, v_image
