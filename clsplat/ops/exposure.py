"""Launch of the stage exposure (cl/exposure.cl)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clsplat.device import Device

# Number of pixels per work-item of the backward kernel on a CPU, and number of work-items on a GPU. The host adds up
# their sums.
CPU_PIXELS = 4096
GPU_ITEMS = 2048


def exposure_fwd(device: Device, image: Array, affine: NDArray[Any], photo: Array) -> Array:
    """Map the colours of an image by the affine map of a photo.

    Parameters
    ----------
    image : (H, W, 3) real
    affine : (3, 4) array on the host
        A and b of A x + b, in the first three columns and in the last one.
    photo : (H, W, 3) uint8
        The result is at most 1 where the photo is 255, and at least 0 where the photo is 0: the camera clips values
        beyond.

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
        Gradient with respect to its result. It is replaced by the gradient with respect to `image`, in place.

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
