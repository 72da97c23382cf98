"""Launch of the stage take (cl/take.cl)."""

from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyopencl.array import Array

from clsplat.device import Device


def take_rows(device: Device, array: Array, rows: NDArray[Any]) -> Array:
    """Take rows of an array, in any order.

    Parameters
    ----------
    array : (N, ...) real
    rows : (M,) integers
        On the host. Row i of the result is row rows[i] < N of the array, or 0 where rows[i] is negative; M >= 1.

    Returns
    -------
    (M, ...) real
    """
    shape = (len(rows), *array.shape[1:])
    result = device.empty(f"rows of {shape[1:]}", shape)
    arguments = [len(rows), prod(shape[1:]), device.upload("rows", rows, np.int32), array, result]
    device.launch("take", "take_rows", (prod(shape),), arguments)
    return result
