"""Launch of the stage sort (cl/sort.cl)."""

from typing import Any

import numpy as np
from pyopencl.array import Array

from clsplat.device import GROUP, Device
from clsplat.errors import InputError
from clsplat.ops.scan import queue_scan

# Length of the longest list that one work-group sorts in local memory. With 64-bit keys it takes 12 KiB; the smallest
# embedded devices have 16 KiB.
BITONIC_MAX = 1024

# Length of the longest segment that a CPU core sorts by the bitonic sort.
CPU_SHORT_SEGMENT = 16


# Number of work-items of a group that sorts on a GPU. Its local memory is then 15 KiB with 32-bit keys.
RADIX_GROUP = 128

# Number of keys per work-item and chunk, RUN in cl/sort.cl.
RADIX_RUN = 8

# Largest number of groups of a radix sort on a GPU. Each adds up the counts of the others.
RADIX_GROUPS = 256


def _defines(device: Device, keys: Array, **changes: Any) -> dict[str, Any]:
    return {
        "KEY_BITS": 8 * keys.dtype.itemsize,
        # The 2048 counters of a core fit into its L1 cache. A group of a GPU has 256 in local memory.
        "DIGIT_BITS": 11 if device.is_cpu else 8,
        "GROUP": 1 if device.is_cpu else device.group(RADIX_GROUP),
        # A work-item of a GPU has 16 counters in local memory.
        "SEGMENT_BITS": 8 if device.is_cpu else 4,
        "SEGMENT_GROUP": 1 if device.is_cpu else device.group(GROUP),
        "BITONIC": BITONIC_MAX,
        "BITONIC_GROUP": device.group(GROUP),
    } | changes


def argsort(
    device: Device, keys: Array, bits: int, method: str = "auto", *, values: Array | None = None
) -> tuple[Array, Array]:
    """Stable argsort of unsigned keys.

    Parameters
    ----------
    keys : (n,) uint32 or uint64, n >= 1
        Not modified.
    bits : int
        Number of low bits that may be set. Fewer bits need fewer passes.
    method : {"auto", "radix", "bitonic"}
        "auto" selects "bitonic" for at most `BITONIC_MAX` keys.
    values : (n,) uint32, optional
        Permuted instead of the positions 0 to n - 1. Not modified.

    Returns
    -------
    sorted_keys : (n,) of the keys' type
    order : (n,) uint32
        sorted_keys = keys[order]; equal keys keep their order. With `values`: values[order].

    Raises
    ------
    InputError
        If method is "bitonic" and there are more than `BITONIC_MAX` keys.
    """
    n = keys.shape[0]
    if method == "bitonic" and n > BITONIC_MAX:
        raise InputError(f"keys: expected at most {BITONIC_MAX} for a bitonic sort, found {n}; use the radix sort")
    defines = _defines(device, keys)
    positions = int(values is None)
    if method == "bitonic" or (method == "auto" and n <= BITONIC_MAX):
        sorted_keys = device.empty("sort keys", n, keys.dtype)
        order = device.empty("sort order", n, np.uint32)
        arguments = [n, positions, keys, order if values is None else values, sorted_keys, order]
        group = (defines["BITONIC_GROUP"],)
        device.launch("sort", "sort_bitonic", group, arguments, defines=defines, group=group)
        return sorted_keys, order

    group, digit_bits = (defines["GROUP"],), defines["DIGIT_BITS"]
    # A few blocks per core on a CPU, and whole chunks on a GPU.
    groups = 4 * device.cl_device.max_compute_units if group == (1,) else -(-n // (group[0] * RADIX_RUN))
    groups = groups if group == (1,) else min(groups, RADIX_GROUPS)
    size = (groups * group[0],)
    histogram = device.empty("sort histogram", groups << digit_bits, np.uint32)
    order = keys if values is None else values  # not read in the first pass
    for shift in range(0, max(bits, 1), digit_bits):
        arguments = [n, groups, shift, keys, histogram]
        device.launch("sort", "sort_count", size, arguments, defines=defines, group=group)
        offsets = queue_scan(device, histogram)[0] if group == (1,) else histogram
        keys_out = device.empty("sort keys", n, keys.dtype)
        order_out = device.empty("sort order", n, np.uint32)
        arguments = [n, groups, shift, positions, keys, order, offsets, keys_out, order_out]
        device.launch("sort", "sort_scatter", size, arguments, defines=defines, group=group)
        keys, order, positions = keys_out, order_out, 0
    return keys, order


def argsort_segments(device: Device, keys: Array, bits: int, ranges: Array, values: Array | None = None) -> Array:
    """Stable argsort of unsigned keys within segments of an array.

    Parameters
    ----------
    keys : (n,) uint32 or uint64, n >= 1
        Not modified.
    bits : int
        Number of low bits that may be set. Fewer bits need fewer passes.
    ranges : (s, 2) uint32
        Begin and end of each segment. Segments do not overlap.
    values : (n,) uint32, optional
        Permuted instead of the positions 0 to n - 1. Not modified.

    Returns
    -------
    order : (n,) uint32
        keys[order] is sorted within each segment; equal keys keep their order. With `values`: values[order].
        Undefined outside of segments.
    """
    n, segments = keys.shape[0], ranges.shape[0]
    defines = _defines(device, keys)
    if device.is_cpu:
        defines |= {"BITONIC": CPU_SHORT_SEGMENT, "BITONIC_GROUP": 1}
    positions = int(values is None)
    order = device.empty("sort order", n, np.uint32)
    values_in = order if values is None else values
    group = defines["BITONIC_GROUP"]
    device.launch(
        "sort",
        "sort_short_segments",
        (segments * group,),
        [positions, ranges, keys, values_in, order],
        defines=defines,
        group=(group,),
    )
    group = defines["SEGMENT_GROUP"]
    sorted_keys, spare_keys = (device.empty("sort keys", n, keys.dtype) for _ in range(2))
    spare = device.empty("sort order", n, np.uint32)
    device.launch(
        "sort",
        "sort_long_segments",
        (segments * group,),
        [positions, max(bits, 1), ranges, keys, values_in, sorted_keys, order, spare_keys, spare],
        defines=defines,
        group=(group,),
    )
    return order
