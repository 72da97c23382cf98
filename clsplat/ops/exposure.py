"""Launch of the stage exposure (cl/exposure.cl)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.ops.disparity import pixel_shares


def exposure_fwd(device: Device, image: Array, affine: NDArray[Any], photo: Array) -> Array:
    """Map the colours of an image by the affine map of a photo.

    Parameters
    ----------
    image : (H, W, 3) real
    affine : (3, 4) or (3, 6) array on the host
        A and b of A x + b, in the first three columns and in the fourth one. Two more columns are c and f, per
        channel, of the terms c x (1 - x) and f r^2 x, where r is 1 in the corners of the image and 0 in its middle.
    photo : (H, W, 3) uint8
        The result is at most 1 where the photo is 255, and at least 0 where the photo is 0: the camera clips values
        beyond.

    Returns
    -------
    (H, W, 3) real
    """
    pixels = image.size // 3
    adjusted = device.empty("adjusted image", image.shape)
    packed, response, defines = _packed(device, image, affine)
    arguments = [pixels, packed, image, photo, adjusted, *response]
    device.launch("exposure", "exposure_fwd", (pixels,), arguments, defines=defines)
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
    v_affine : float64, on the host, of the shape of `affine`
    """
    pixels = image.size // 3
    items, *shares = pixel_shares(device, pixels)
    packed, response, defines = _packed(device, image, affine)
    parts = device.empty("v_affine", (items, affine.size))
    arguments = [pixels, items, *shares, packed, image, photo, v_image, parts, *response]
    device.launch("exposure", "exposure_bwd", (items,), arguments, defines=defines)
    total = parts.get().sum(axis=0, dtype=np.float64)
    return np.concatenate([total[:12].reshape(3, 4), total[12:].reshape(-1, 3).T], axis=1)


def _packed(device: Device, image: Array, affine: NDArray[Any]) -> tuple[NDArray[Any], list[Any], dict[str, Any]]:
    """The map as the kernels read it: `affine`, the arguments for its columns beyond the fourth, and the defines."""
    packed, response = np.zeros(16, device.real), np.zeros(8, device.real)
    packed[:12] = affine[:, :4].ravel()
    if affine.shape[1] == 4:
        return packed, [], {"RESPONSE": 0}
    response[:6] = affine[:, 4:].T.ravel()
    return packed, [response, image.shape[1], image.shape[0]], {"RESPONSE": 1}
