"""Launch of the stage scan (cl/scan.cl)."""

import numpy as np
from pyopencl.array import Array

from clsplat.buffers import Reading
from clsplat.device import GROUP, Device
from clsplat.errors import DeviceError

# Largest number of values that one core of a CPU sums up alone: that takes no longer than a second launch.
SMALL = 16384


def exclusive_scan(device: Device, values: Array, what: str = "scan") -> tuple[Array, int]:
    """Exclusive prefix sum.

    Parameters
    ----------
    values : (n,) uint32, n >= 1
    what : str
        Name of the sum in the error.

    Returns
    -------
    sums : (n + 1,) uint32
        sums[i] is the sum of values[:i].
    total : int
        Sum of all values, read back from the device.

    Raises
    ------
    DeviceError
        If the total exceeds 2^32 - 1.
    """
    sums, partial = queue_scan(device, values)
    return sums, checked_total(Reading(partial), what)


def checked_total(reading: Reading, what: str) -> int:
    """Wait for the total of `queue_scan`. Errors as for `exclusive_scan`."""
    total = int(reading)
    if total >= 2**32:
        raise DeviceError(
            f"{what}: expected a total below 2^32, found {total}; use fewer Gaussians or a smaller image"
        )
    return total


def queue_scan(device: Device, values: Array) -> tuple[Array, Array]:
    """Queue an exclusive scan without waiting. Returns the sums, and an array that ends with their 64-bit total."""
    n = values.shape[0]
    # A few chunks per core on a CPU; otherwise enough work-items to fill any GPU.
    chunks = 4 * device.cl_device.max_compute_units if device.is_cpu else 8192
    chunks = 1 if device.is_cpu and n <= SMALL else min(chunks, n)
    defines = {"GROUP": 1 if device.is_cpu else device.group(GROUP)}
    partial = device.empty("scan", chunks + 1, np.uint64)
    sums = device.empty("scan", n + 1, np.uint32)
    # On a CPU, a group runs on one core, so each group has one chunk.
    group = (defines["GROUP"],)
    size = (-(-chunks // group[0]) * group[0],)
    if chunks > 1:
        device.launch("scan", "scan_reduce", size, [n, chunks, values, partial], defines=defines, group=group)
    device.launch("scan", "scan_down", size, [n, chunks, values, partial, sums], defines=defines, group=group)
    return sums, partial
