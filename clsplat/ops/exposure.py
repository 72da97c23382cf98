"""Launch of the stage exposure (cl/exposure.cl)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clsplat.device import Device

# Pixels per work-item of the backward kernel on a CPU, and work-items on a GPU: their sums are added up on the host.
CPU_PIXELS = 4096
GPU_ITEMS = 2048


def exposure_fwd(device: Device, image: Array, affine: NDArray[Any], photo: Array) -> Array:
    """Map an image's colours, as the camera of a photo would show them.

    Parameters
    ----------
    image : (H, W, 3) real
    affine : (3, 4) array on the host
        A and b of A x + b, side by side.
    photo : (H, W, 3) uint8
        Where it is 255, the result is 1 at most, where it is 0, 0 at least: what a camera clips, it cannot tell.

    Returns
    -------
    (H, W, 3) real
    """
    pixels = image.size // 3
    adjusted = device.empty("adjusted image", image.shape)
    device.launch("exposure", "exposure_fwd", (pixels,), [pixels, _packed(device, affine), image, photo, adjusted])
    return adjusted


def exposure_bwd(
    device: Device, image: Array, affine: NDArray[Any], photo: Array, v_image: Array
) -> NDArray[np.float64]:
    """Gradients of `exposure_fwd`.

    Parameters
    ----------
    image, affine, photo
        As given to `exposure_fwd`.
    v_image : (H, W, 3) real
        Gradient with respect to its result; becomes that with respect to `image`, in place.

    Returns
    -------
    v_affine : (3, 4) float64, on the host
    """
    pixels = image.size // 3
    if device.is_cpu:
        items, first, step, count = -(-pixels // CPU_PIXELS), CPU_PIXELS, 1, CPU_PIXELS
    else:
        items, first, step, count = GPU_ITEMS, 1, GPU_ITEMS, -(-pixels // GPU_ITEMS)
    parts = device.empty("v_affine", (items, 12))
    arguments = [pixels, items, first, step, count, _packed(device, affine), image, photo, v_image, parts]
    device.launch("exposure", "exposure_bwd", (items,), arguments)
    return np.asarray(parts.get().sum(axis=0, dtype=np.float64).reshape(3, 4))


def _packed(device: Device, affine: NDArray[Any]) -> NDArray[Any]:
    packed = np.zeros(16, device.real)
    packed[:12] = affine.ravel()
    return packed
