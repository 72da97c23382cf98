"""Launch of the stage filter (cl/filter.cl)."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.constants import FILTER_VARIANCE
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.structs import camera_struct, lens_define

# Of the kernels that see no camera; all are built together.
DEFINES = {"FILTER_VARIANCE": FILTER_VARIANCE, "LENS": "PINHOLE"}


def pixel_sizes(device: Device, gaussians: Gaussians, cameras: Iterable[Camera]) -> Any:
    """The smallest size of a pixel at each Gaussian, of all cameras that see it.

    Parameters
    ----------
    gaussians : Gaussians of N >= 1 rows
    cameras : iterable of Camera
        One sees a Gaussian whose centre lies where it draws Gaussians and in its image, enlarged as for the clamp.

    Returns
    -------
    (N,)
        depth/focal (orthographic: 1/focal), in world units. Where no camera sees a Gaussian the largest of all; 0
        where none sees any.
    """
    n = len(gaussians)
    result = device.upload("pixel sizes", np.full(n, np.inf))
    for camera in cameras:
        arguments = [n, camera_struct(camera, device.real), gaussians.means, result]
        device.launch("filter", "pixel_sizes", (n,), arguments, defines=DEFINES | {"LENS": lens_define(camera)})
    sizes = result.get()
    seen = np.isfinite(sizes)
    if not seen.all():
        sizes[~seen] = sizes[seen].max(initial=0)
        result.set(sizes)
    return result


def filter_fwd(device: Device, gaussians: Gaussians, pixels: Any) -> Gaussians:
    """Gaussians that are no thinner than the cameras can resolve, and as much less opaque.

    Parameters
    ----------
    gaussians : Gaussians of N >= 1 rows
    pixels : (N,)
        As `pixel_sizes` gives them; 0 leaves a Gaussian as it is.

    Returns
    -------
    Gaussians
        With log_scales and logit_opacities of their own; the other fields are shared.
    """
    n = len(gaussians)
    log_scales: Any
    logits: Any
    log_scales, logits = device.empty("filtered scales", (n, 3)), device.empty("filtered opacities", n)
    arguments = [n, pixels, gaussians.log_scales, gaussians.logit_opacities, log_scales, logits]
    device.launch("filter", "filter_fwd", (n,), arguments, defines=DEFINES)
    return replace(gaussians, log_scales=log_scales, logit_opacities=logits)


def filter_bwd(device: Device, gaussians: Gaussians, pixels: Any, v: Gaussians) -> Gaussians:
    """Gradients with respect to the Gaussians that were filtered; `v`, of the filtered ones, is changed in place.

    Parameters
    ----------
    gaussians, pixels
        As given to `filter_fwd`.
    v : Gaussians
        Gradients with respect to its result.
    """
    n = len(gaussians)
    arguments = [n, pixels, gaussians.log_scales, gaussians.logit_opacities, v.log_scales, v.logit_opacities]
    device.launch("filter", "filter_bwd", (n,), arguments, defines=DEFINES)
    return v
