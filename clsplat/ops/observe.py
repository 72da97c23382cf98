"""Launch of the stage observe (cl/observe.cl)."""

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device


def observe(
    device: Device, extents: Array, v_means2d: Array, width: int, height: int, grad_sum: Array, seen: Array
) -> None:
    """Add an iteration to the statistics of densification, in place.

    Parameters
    ----------
    extents, v_means2d : (N, 2) real
        Extents of the splats, px, and gradients with respect to their centres, px^-1.
    width, height : int
        Size of the image, px.
    grad_sum : (N,) real
        Sum over iterations of the norm of the positional gradient, in normalised device coordinates.
    seen : (N,) int32
        Number of iterations in which the Gaussian was visible.
    """
    n = seen.shape[0]
    half_size = np.array([width / 2, height / 2], device.real)
    device.launch("observe", "observe", (n,), [n, half_size, extents, v_means2d, grad_sum, seen])


def add_column(device: Device, values: Array, column: int, sums: Array, factor: float = 1.0) -> None:
    """Add a column of an array, times a factor, to sums of twice the precision, in place.

    Parameters
    ----------
    values : (M, W) real
        M >= N; the first N rows count.
    column : int
        Less than W.
    sums : (N, 2) real
        The sum of both columns is the sum of what was added. 0 before the first call.
    factor : float
        The products are rounded.
    """
    n = sums.shape[0]
    device.launch("observe", "add_column", (n,), [n, values.shape[1], column, float(factor), values, sums])
