"""Launch of the stage bin (cl/bin.cl)."""

from collections.abc import Callable
from typing import Any

import numpy as np
from pyopencl.array import Array

from clsplat.buffers import Reading
from clsplat.device import Device
from clsplat.errors import DeviceError, InputError
from clsplat.ops.scan import checked_total, queue_scan
from clsplat.ops.sort import argsort, argsort_segments
from clsplat.stages import AnySplats, Bins

WHAT = "intersections of Gaussians and tiles"

# Name of the lists of intersections in device memory, and bytes of an entry.
LIST, ENTRY = "intersections", 4


def bin_splats(
    device: Device,
    splats: AnySplats,
    width: int,
    height: int,
    tile_size: int,
    *,
    gradients: bool = True,
    scheme: str = "auto",
) -> Bins:
    """List the splats of each tile, sorted by depth and then by index.

    Parameters
    ----------
    splats : Splats of N >= 1 Gaussians
    width, height, tile_size : int
        Size of the image and edge of a tile, px.
    gradients : bool
        True if `composite_bwd` will follow. If False, first_slots and slots of the result are None.
    scheme : {"auto", "global", "per_tile"}
        "global" sorts all splats by depth and distributes them to the tiles. "per_tile" distributes them and sorts
        the list of each tile. The lists are the same; `order` of the result is by depth or by index.

    Raises
    ------
    InputError
        If the scheme is unknown.
    DeviceError
        If the intersections do not fit on the device.
    """
    if scheme not in ("auto", "global", "per_tile"):
        raise InputError(f"scheme: expected auto, global or per_tile, found {scheme!r}")
    by_depth = scheme != "per_tile"
    n = splats.depths.shape[0]
    tile_count = -(-width // tile_size) * -(-height // tile_size)
    defines = {"TILE": tile_size, "GRADIENTS": int(gradients)}
    # The key of a double has 64 bits. The sign bit of a depth is never set, but that of LAST is.
    keys = device.empty("depth keys", n, np.uint32 if device.real == np.float32 else np.uint64)
    bits = 8 * keys.dtype.itemsize
    ellipses = device.empty("ellipses", (n, 8))
    # The global scheme gets its order from the sort; it passes a buffer that the kernel does not touch.
    order = keys if by_depth else device.empty("order", n, np.uint32)
    geometry = [splats.means2d, splats.conics, splats.depths, splats.extents, splats.opacities]
    arguments = [n, int(not by_depth), *geometry, keys, ellipses, order]
    device.launch("bin", "bin_prepare", (-(-n // 8),), arguments, defines=defines)
    if by_depth:
        _, order = argsort(device, keys, bits)

    geometry = [width, height, order, ellipses]
    distribute = _counting_sort if device.is_cpu else _radix_sort
    gauss_ids, slots, first_slots, tile_ranges = distribute(device, n, tile_count, geometry, defines)
    m = gauss_ids.shape[0]
    if m and not by_depth:
        list_keys = device.empty("list keys", m, keys.dtype)
        device.launch("bin", "bin_list_keys", (m,), [m, gauss_ids, keys, list_keys], defines=defines)
        if gradients:
            permutation = argsort_segments(device, list_keys, bits - 1, tile_ranges)
            gauss_ids, slots = (_gather(device, m, permutation, a, defines) for a in (gauss_ids, slots))
        else:
            gauss_ids = argsort_segments(device, list_keys, bits - 1, tile_ranges, gauss_ids)
    bins = Bins(gauss_ids, tile_ranges, order, first_slots, slots, tile_size, width, height)
    return bins if gradients else bins._replace(first_slots=None, slots=None)


def _list(device: Device, m: int) -> Array:
    """A list of m entries. A buffer cannot be empty, so a list without entries has one unused entry."""
    return device.buffers.first(device.empty(LIST, max(m, 1), np.uint32), m)


def _filled(device: Device, sums: Array, count: int, fill: Callable[[list[Any], list[Array]], None]) -> list[Array]:
    """Make `count` lists of M entries by `fill`, where `sums` of `queue_scan` ends with M.

    The device fills them while the host waits for M: they have room for as many entries as earlier lists had. If
    there are more, nothing was written, and `fill` runs again. Its arguments are those of the kernel that tell the
    room and M, and the lists.
    """
    reading, last = Reading(sums), sums.shape[0] - 1

    def made(room: int) -> list[Array]:
        lists = [device.empty(LIST, room, np.uint32) for _ in range(count)]
        fill([room, last, sums], lists)
        return lists

    room = device.buffers.capacity(LIST, ENTRY * device.lengths.get(LIST, 1)) // ENTRY
    try:
        lists = made(room)
    except DeviceError:  # there may be memory for lists of M entries
        room, lists = -1, []
    m = checked_total(reading, WHAT)
    device.lengths[LIST] = max(m, 1)
    if m > room:
        lists.clear()  # their memory is free before that of the others is needed
        lists = made(max(m, 1))
    return [device.buffers.first(a, m) for a in lists]


def _gather(device: Device, m: int, permutation: Array, values: Array, defines: dict[str, Any]) -> Array:
    result = _list(device, m)
    device.launch("bin", "bin_gather", (m,), [m, permutation, values, result], defines=defines)
    return result


def _counting_sort(
    device: Device, n: int, tile_count: int, geometry: list[Any], defines: dict[str, Any]
) -> tuple[Array, Array, Array, Array]:
    """gauss_ids, slots, first_slots and tile_ranges by a counting sort, in which each core has its own counters."""
    runs = min(n, 4 * device.cl_device.max_compute_units)
    head = [n, runs, tile_count, *geometry]
    counters = device.empty("tile counters", (runs, tile_count), np.uint32)
    # Without gradients, the kernels do not access these.
    counts = first_slots = counters
    if defines["GRADIENTS"]:
        counts = device.empty("tiles per Gaussian", n, np.uint32)
    device.launch("bin", "bin_histogram", (runs,), [*head, counters, counts], defines=defines, group=(1,))
    totals = device.empty("tile totals", tile_count, np.uint32)
    device.launch("bin", "bin_totals", (tile_count,), [runs, tile_count, counters, totals], defines=defines)
    tile_begins, partial = queue_scan(device, totals)
    if defines["GRADIENTS"]:
        first_slots, _ = queue_scan(device, counts)

    def scatter(room: list[Any], lists: list[Array]) -> None:
        arguments = [*head, counters, tile_begins, first_slots, *room, lists[0], lists[-1]]
        device.launch("bin", "bin_scatter", (runs,), arguments, defines=defines, group=(1,))

    gauss_ids, *slots = _filled(device, partial, 1 + defines["GRADIENTS"], scatter)
    tile_ranges = device.empty("tile ranges", (tile_count, 2), np.uint32)
    device.launch("bin", "bin_ranges", (tile_count,), [tile_count, tile_begins, tile_ranges], defines=defines)
    return gauss_ids, slots[0] if slots else gauss_ids, first_slots, tile_ranges


def _radix_sort(
    device: Device, n: int, tile_count: int, geometry: list[Any], defines: dict[str, Any]
) -> tuple[Array, Array, Array, Array]:
    """The same result as `_counting_sort`, by a radix sort of the tile numbers, which uses all cores of a GPU."""
    counts = device.empty("tiles per Gaussian", n, np.uint32)
    device.launch("bin", "bin_count", (n,), [n, *geometry, counts], defines=defines)
    first_slots, partial = queue_scan(device, counts)

    def emit(room: list[Any], lists: list[Array]) -> None:
        device.launch("bin", "bin_emit", (n,), [n, *geometry, first_slots, *room, *lists], defines=defines)

    tiles, slot_gauss = _filled(device, partial, 2, emit)
    m = tiles.shape[0]
    tile_ranges = device.empty("tile ranges", (tile_count, 2), np.uint32)
    gauss_ids = slots = slot_gauss
    if m:
        if defines["GRADIENTS"]:
            tiles, slots = argsort(device, tiles, tile_count.bit_length())
            gauss_ids = _gather(device, m, slots, slot_gauss, defines)
        else:
            tiles, gauss_ids = argsort(device, tiles, tile_count.bit_length(), values=slot_gauss)
    device.launch("bin", "bin_bisect", (tile_count,), [m, tile_count, tiles, tile_ranges], defines=defines)
    return gauss_ids, slots, first_slots, tile_ranges
