"""Launch of the stage rays (cl/rays.cl)."""

from typing import Any

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import RayColors


def _behind(device: Device, background: Any) -> list[Any]:
    """Whether each ray has a background of its own, and the backgrounds."""
    if isinstance(background, Array):
        return [1, background]
    return [0, device.upload("background", np.reshape(background, (1, 3)))]


def rays_fwd(device: Device, sigmas: Array, colors: Array, deltas: Array, first: Array, background: Any) -> RayColors:
    """Composite the samples of rays, front to back (Mildenhall et al. 2020, equation 3).

    Parameters
    ----------
    sigmas : (S,) real
        Densities, 1/length.
    colors : (S, 3) real
    deltas : (S,) real
        Lengths of the segments that the samples stand for.
    first : (R + 1,) uint32
        Ray r has the samples first[r] to first[r + 1].
    background : (3,) floats on the host, or (R, 3) real on the device
        Colour behind all samples, of all rays or of each.

    Returns
    -------
    RayColors
    """
    rays = first.shape[0] - 1
    rgb, behind = device.empty("colours of rays", (rays, 3)), device.empty("behind rays", rays)
    transmittances = device.empty("transmittances", sigmas.shape[0])
    arguments = [rays, *_behind(device, background), sigmas, colors, deltas, first, rgb, transmittances, behind]
    device.launch("rays", "rays_fwd", (rays,), arguments)
    return RayColors(rgb, transmittances, behind)


def rays_bwd(
    device: Device,
    sigmas: Array,
    colors: Array,
    deltas: Array,
    first: Array,
    background: Any,
    transmittances: Array,
    v_rgb: Array,
) -> tuple[Array, Array]:
    """Gradients of `rays_fwd`.

    Parameters
    ----------
    sigmas, colors, deltas, first, background
        As given to `rays_fwd`.
    transmittances : (S,) real
        As returned by `rays_fwd`.
    v_rgb : (R, 3) real
        Gradient with respect to the colours of the rays.

    Returns
    -------
    v_sigmas : (S,) real
    v_colors : (S, 3) real
    """
    rays = first.shape[0] - 1
    v_sigmas, v_colors = device.empty("v_sigmas", sigmas.shape), device.empty("v_colors", colors.shape)
    arguments = [
        rays,
        *_behind(device, background),
        sigmas,
        colors,
        deltas,
        first,
        transmittances,
        v_rgb,
        v_sigmas,
        v_colors,
    ]
    device.launch("rays", "rays_bwd", (rays,), arguments)
    return v_sigmas, v_colors
