"""Launch of the stage take (cl/take.cl)."""

from math import prod

from pyopencl.array import Array

from clsplat.device import Device


def take_rows(device: Device, array: Array, rows: Array) -> Array:
    """Take rows of an array, in any order.

    Parameters
    ----------
    array : (N, ...) real
    rows : (M,) int32
        Row i of the result is row rows[i] < N of the array, or 0 where rows[i] is negative; M >= 1.

    Returns
    -------
    (M, ...) real
    """
    m, *tail = rows.shape[0], *array.shape[1:]
    result = device.empty(f"rows of {tail}", (m, *tail))
    device.launch("take", "take_rows", (m * prod(tail),), [m, prod(tail), rows, array, result])
    return result
