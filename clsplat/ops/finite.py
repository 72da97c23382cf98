"""Launch of the stage finite (cl/finite.cl)."""

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device


def count_not_finite(device: Device, values: Array) -> int:
    """Count the values of an array that are infinite or not a number.

    Parameters
    ----------
    values : real array of any shape, with at least one value
    """
    count = device.zeros("values that are not finite", 1, np.uint32)
    device.launch("finite", "count_not_finite", (values.size,), [values.size, values, count])
    return int(count.get()[0])
