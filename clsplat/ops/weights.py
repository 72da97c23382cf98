"""Launches of the stage weights (cl/weights.cl)."""

from pyopencl.array import Array

from clsplat.device import Device


def weights_fwd(device: Device, sigmas: Array, deltas: Array, count: int) -> Array:
    """Weights of samples in the colours of their rays (Mildenhall et al. 2020, equation 5).

    Parameters
    ----------
    sigmas, deltas : (R N,) real
        Densities, and lengths of the segments that they stand for.
    count : int
        Samples of each ray, N.

    Returns
    -------
    (R N,) real
    """
    weights, rays = device.empty("weights of samples", sigmas.shape[0]), sigmas.shape[0] // count
    device.launch("weights", "weights_fwd", (rays,), [rays, count, sigmas, deltas, weights])
    return weights


def weights_bwd(
    device: Device, sigmas: Array, deltas: Array, count: int, weights: Array, v_weights: Array, v_sigmas: Array
) -> None:
    """Add the gradient of `weights_fwd` to `v_sigmas`.

    Parameters
    ----------
    sigmas, deltas, count
        As given to `weights_fwd`.
    weights
        As returned by it.
    v_weights, v_sigmas : (R N,) real
    """
    rays = sigmas.shape[0] // count
    arguments = [rays, count, sigmas, deltas, weights, v_weights, v_sigmas]
    device.launch("weights", "weights_bwd", (rays,), arguments)
