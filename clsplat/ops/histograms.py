"""Launches of the stage histograms (cl/histograms.cl)."""

from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import INTERLEVEL_EPS

DEFINES = {"INTERLEVEL_EPS": INTERLEVEL_EPS}


def histograms_interlevel(
    device: Device, edges: Array, weights: Array, outer_edges: Array, outer_weights: Array, scale: float
) -> tuple[Array, Array]:
    """Loss of weights that outer weights do not bound (Barron et al. 2022, equation 13).

    Parameters
    ----------
    edges : (R, N + 1) real
        Of intervals, ascending.
    weights : (R N,) real
        They count as given: there is no gradient with respect to them.
    outer_edges : (R, M + 1) real
        Of the intervals of the proposal.
    outer_weights : (R M,) real
    scale : float
        Factor on the gradient.

    Returns
    -------
    losses : (R,) real
    v_outer_weights : (R M,) real
        Gradient of the sum of the losses, times `scale`.
    """
    rays, count, outer_count = edges.shape[0], edges.shape[1] - 1, outer_edges.shape[1] - 1
    losses, v_outer = device.empty("losses of rays", rays), device.empty("v_weights", outer_weights.shape)
    scalars = [rays, count, outer_count, float(scale)]
    arguments = [*scalars, edges, weights, outer_edges, outer_weights, losses, v_outer]
    device.launch("histograms", "histograms_interlevel", (rays,), arguments, defines=DEFINES)
    return losses, v_outer


def histograms_distortion(device: Device, edges: Array, weights: Array, scale: float) -> tuple[Array, Array]:
    """Loss of weights that are spread along a ray (Barron et al. 2022, equation 15).

    Parameters
    ----------
    edges : (R, N + 1) real
        Of intervals, ascending.
    weights : (R N,) real
    scale : float
        Factor on the gradient.

    Returns
    -------
    losses : (R,) real
    v_weights : (R N,) real
        Gradient of the sum of the losses, times `scale`.
    """
    rays, count = edges.shape[0], edges.shape[1] - 1
    losses, v_weights = device.empty("losses of rays", rays), device.empty("v_weights", weights.shape)
    arguments = [rays, count, float(scale), edges, weights, losses, v_weights]
    device.launch("histograms", "histograms_distortion", (rays,), arguments, defines=DEFINES)
    return losses, v_weights
