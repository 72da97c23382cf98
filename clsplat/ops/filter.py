"""Launch of the stage filter (cl/filter.cl)."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.constants import FILTER_VARIANCE
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.structs import camera_struct

# Defines of the kernels that use no camera. LENS is required, since all kernels of the file are built together.
DEFINES = {"FILTER_VARIANCE": FILTER_VARIANCE, "LENS": "PINHOLE"}


def pixel_sizes(device: Device, gaussians: Gaussians, cameras: Iterable[Camera]) -> Any:
    """Smallest size of a pixel at each Gaussian, over all cameras that see it.

    Parameters
    ----------
    gaussians : Gaussians of N >= 1 rows
    cameras : iterable of Camera
        A camera sees a Gaussian if the centre is not culled and lies in the image, enlarged by FRUSTUM_MARGIN.

    Returns
    -------
    (N,)
        depth/focal (orthographic: 1/focal), world units. For Gaussians that no camera sees, the largest of the
        others; 0 if no camera sees any Gaussian.
    """
    n = len(gaussians)
    result = device.upload("pixel sizes", np.full(n, np.inf))
    for camera in cameras:
        arguments = [n, camera_struct(camera, device.real), gaussians.means, result]
        device.launch("filter", "pixel_sizes", (n,), arguments, defines=DEFINES | {"LENS": camera.model.upper()})
    sizes = result.get()
    seen = np.isfinite(sizes)
    if not seen.all():
        sizes[~seen] = sizes[seen].max(initial=0)
        result.set(sizes)
    return result


def filter_fwd(device: Device, gaussians: Gaussians, pixels: Any) -> Gaussians:
    """Widen Gaussians to at least the size that the cameras resolve, and reduce their opacities accordingly.

    Parameters
    ----------
    gaussians : Gaussians of N >= 1 rows
    pixels : (N,)
        Result of `pixel_sizes`. 0 leaves a Gaussian unchanged.

    Returns
    -------
    Gaussians
        log_scales and logit_opacities are new arrays; the other fields are shared with the input.
    """
    n = len(gaussians)
    log_scales: Any
    logits: Any
    log_scales, logits = device.empty("filtered scales", (n, 3)), device.empty("filtered opacities", n)
    arguments = [n, pixels, gaussians.log_scales, gaussians.logit_opacities, log_scales, logits]
    device.launch("filter", "filter_fwd", (n,), arguments, defines=DEFINES)
    return replace(gaussians, log_scales=log_scales, logit_opacities=logits)


def filter_bwd(device: Device, gaussians: Gaussians, pixels: Any, v: Gaussians) -> Gaussians:
    """Gradients of `filter_fwd`.

    Parameters
    ----------
    gaussians, pixels
        As given to `filter_fwd`.
    v : Gaussians
        Gradients with respect to its result. They are replaced by gradients with respect to `gaussians`, in place.
    """
    n = len(gaussians)
    arguments = [n, pixels, gaussians.log_scales, gaussians.logit_opacities, v.log_scales, v.logit_opacities]
    device.launch("filter", "filter_bwd", (n,), arguments, defines=DEFINES)
    return v
