"""Launch of the stage bin (cl/bin.cl)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from pyopencl.array import Array

from clsplat.buffers import Reading
from clsplat.device import Device
from clsplat.errors import DeviceError, InputError
from clsplat.ops.scan import checked_total, queue_scan
from clsplat.ops.sort import argsort, argsort_segments
from clsplat.stages import AnySplats, Bins

WHAT = "intersections of Gaussians and tiles"


class _Walk(NamedTuple):
    """N splats in the order in which they are distributed to T tiles."""

    n: int
    tile_count: int
    # Arguments of the kernels that walk over the splats' tiles.
    arguments: list[Any]
    # The splats in that order; None: by index.
    order: Array | None
    # Number of tiles of each splat, and first slot; None without gradients.
    counts: Array
    first_slots: Array | None
    defines: dict[str, Any]


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
        the list of each tile. The results are the same.

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
    defines = {"TILE": tile_size, "GRADIENTS": int(gradients), "LANES": 8 if device.is_cpu else 1}
    # The key of a double has 64 bits. The sign bit of a depth is never set, but that of LAST is.
    keys = device.empty("depth keys", n, np.uint32 if device.real == np.float32 else np.uint64)
    bits = 8 * keys.dtype.itemsize
    covers = device.empty("tiles of each Gaussian", (n, 4), np.uint32)
    counts = device.empty("tiles per Gaussian", n, np.uint32)
    geometry = [splats.means2d, splats.conics, splats.extents, splats.opacities]
    arguments = [n, width, height, splats.depths, *geometry, keys, covers, counts]
    device.launch("bin", "bin_prepare", (-(-n // defines["LANES"]),), arguments, defines=defines)
    first_slots = queue_scan(device, counts)[0] if gradients else None
    order = argsort(device, keys, bits)[1] if by_depth else None

    arguments = [width, height, int(not by_depth), counts if order is None else order, covers, *geometry]
    distribute = _counting_sort if device.is_cpu else _radix_sort
    walk = _Walk(n, tile_count, arguments, order, counts, first_slots, defines)
    gauss_ids, slots, tile_ranges = distribute(device, walk)
    m = gauss_ids.shape[0]
    if m and not by_depth:
        list_keys = device.empty("list keys", m, keys.dtype)
        device.launch("bin", "bin_list_keys", (m,), [m, gauss_ids, keys, list_keys], defines=defines)
        if gradients:
            permutation = argsort_segments(device, list_keys, bits - 1, tile_ranges)
            gauss_ids, slots = (_gather(device, m, permutation, a, defines) for a in (gauss_ids, slots))
        else:
            gauss_ids = argsort_segments(device, list_keys, bits - 1, tile_ranges, gauss_ids)
    return Bins(gauss_ids, tile_ranges, first_slots, slots if gradients else None, tile_size, width, height)


def check_slots(bins: Bins) -> None:
    """Raise an InputError if lists were made without gradients."""
    if bins.slots is None:
        raise InputError(
            "bins: expected lists made with gradients=True, found lists without slots; bin the splats anew"
        )


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


def _counting_sort(device: Device, walk: _Walk) -> tuple[Array, Array, Array]:
    """gauss_ids, slots and tile_ranges by a counting sort, in which each core has its own counters."""
    tile_count, first_slots, defines = walk.tile_count, walk.first_slots, walk.defines
    runs = min(walk.n, 4 * device.cl_device.max_compute_units)
    head = [walk.n, runs, tile_count, *walk.arguments]
    counters = device.empty("tile counters", (runs, tile_count), np.uint32)
    device.launch("bin", "bin_histogram", (runs,), [*head, counters], defines=defines, group=(1,))
    totals = device.empty("tile totals", tile_count, np.uint32)
    device.launch("bin", "bin_totals", (tile_count,), [runs, tile_count, counters, totals], defines=defines)
    tile_begins, partial = queue_scan(device, totals)
    # Without gradients, the kernel does not access the slots.
    slots_in = counters if first_slots is None else first_slots

    def scatter(room: list[Any], lists: list[Array]) -> None:
        arguments = [*head, counters, tile_begins, slots_in, *room, lists[0], lists[-1]]
        device.launch("bin", "bin_scatter", (runs,), arguments, defines=defines, group=(1,))

    gauss_ids, *slots = _filled(device, partial, 1 + defines["GRADIENTS"], scatter)
    tile_ranges = device.empty("tile ranges", (tile_count, 2), np.uint32)
    device.launch("bin", "bin_ranges", (tile_count,), [tile_count, tile_begins, tile_ranges], defines=defines)
    return gauss_ids, slots[0] if slots else gauss_ids, tile_ranges


def _radix_sort(device: Device, walk: _Walk) -> tuple[Array, Array, Array]:
    """The same result as `_counting_sort`, by a radix sort of the tile numbers, which uses all cores of a GPU."""
    n, tile_count, arguments, order, counts, first_slots, defines = walk
    if order is not None:
        by_index, counts = counts, device.empty("tiles per Gaussian", n, np.uint32)
        device.launch("bin", "bin_gather", (n,), [n, order, by_index, counts], defines=defines)
    positions, partial = queue_scan(device, counts)
    slots_in = positions if first_slots is None else first_slots

    def emit(room: list[Any], lists: list[Array]) -> None:
        more = [positions, slots_in, *room, lists[0], lists[1], lists[-1]]
        device.launch("bin", "bin_emit", (n,), [n, *arguments, *more], defines=defines)

    tiles, entries, *owners = _filled(device, partial, 2 + defines["GRADIENTS"], emit)
    m = tiles.shape[0]
    if m:
        tiles, entries = argsort(device, tiles, tile_count.bit_length(), values=entries)
    tile_ranges = device.empty("tile ranges", (tile_count, 2), np.uint32)
    device.launch("bin", "bin_bisect", (tile_count,), [m, tile_count, tiles, tile_ranges], defines=defines)
    gauss_ids = _gather(device, m, entries, owners[0], defines) if m and owners else entries
    return gauss_ids, entries, tile_ranges
