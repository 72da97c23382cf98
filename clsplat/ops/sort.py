"""Launch of the stage sort (cl/sort.cl)."""

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.ops.scan import queue_scan

# Longest list that one work-group sorts in local memory: 12 KiB with 64-bit keys, within the 16 KiB of the smallest
# embedded devices.
BITONIC_MAX = 1024


def argsort(device: Device, keys: Array, bits: int, method: str = "auto") -> tuple[Array, Array]:
    """Stable argsort of unsigned keys.

    Parameters
    ----------
    keys : (n,) uint32 or uint64, n >= 1
        Left unchanged.
    bits : int
        Number of low bits that may be set; fewer take fewer passes.
    method : {"auto", "radix", "bitonic"}
        auto takes bitonic for at most `BITONIC_MAX` keys.

    Returns
    -------
    sorted_keys : (n,) of the keys' type
    order : (n,) uint32
        sorted_keys = keys[order]; equal keys keep their order.

    Raises
    ------
    InputError
        If there are more keys than a bitonic sort that was asked for can hold.
    """
    n = keys.shape[0]
    if method == "bitonic" and n > BITONIC_MAX:
        raise InputError(f"keys: expected at most {BITONIC_MAX} for a bitonic sort, found {n}; use the radix sort")
    defines = {
        "KEY_BITS": 8 * keys.dtype.itemsize,
        # A core counts 2048 digits in its L1 cache; a GPU's work-item keeps 16 counters in local memory.
        "DIGIT_BITS": 11 if device.is_cpu else 4,
        "GROUP": 1 if device.is_cpu else 64,
        "BITONIC": BITONIC_MAX,
        "BITONIC_GROUP": 64,
    }
    if method == "bitonic" or (method == "auto" and n <= BITONIC_MAX):
        sorted_keys = device.empty("sort keys", n, keys.dtype)
        order = device.empty("sort order", n, np.uint32)
        device.launch("sort", "sort_bitonic", (64,), [n, keys, sorted_keys, order], defines=defines, group=(64,))
        return sorted_keys, order

    group, digit_bits = defines["GROUP"], defines["DIGIT_BITS"]
    # Blocks: a few per core, or runs of about 16 keys per work-item.
    groups = 4 * device.cl_device.max_compute_units if device.is_cpu else -(-n // (group * 16))
    histogram = device.empty("sort histogram", groups << digit_bits, np.uint32)
    values = device.empty("sort order", n, np.uint32)
    for shift in range(0, max(bits, 1), digit_bits):
        first = shift == 0
        device.launch(
            "sort",
            "sort_count",
            (groups * group,),
            [n, groups, shift, keys, histogram],
            defines=defines,
            group=(group,),
        )
        offsets, _ = queue_scan(device, histogram)
        keys_out = device.empty("sort keys", n, keys.dtype)
        values_out = device.empty("sort order", n, np.uint32)
        device.launch(
            "sort",
            "sort_scatter",
            (groups * group,),
            [n, groups, shift, int(first), keys, values, offsets, keys_out, values_out],
            defines=defines,
            group=(group,),
        )
        keys, values = keys_out, values_out
    return keys, values
