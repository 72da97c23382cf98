"""Launch of the stage bin (cl/bin.cl)."""

import numpy as np

from clsplat.device import Device
from clsplat.ops.scan import exclusive_scan
from clsplat.ops.sort import argsort
from clsplat.stages import Bins, Splats


def bin_splats(device: Device, splats: Splats, width: int, height: int, tile_size: int) -> Bins:
    """Lists of splats per tile, by depth and then by index.

    Parameters
    ----------
    splats : Splats of N >= 1 Gaussians
    width, height : int
        Image size in pixels.
    tile_size : int
        Edge of a tile in pixels.

    Raises
    ------
    DeviceError
        If the intersections do not fit the device.
    """
    n = splats.depths.shape[0]
    defines = {"TILE": tile_size}
    # A double's sort key is 64 bits wide; the sign bit of a depth is never set, but that of LAST is.
    keys = device.empty("depth keys", n, np.uint32 if device.real == np.float32 else np.uint64)
    device.launch("bin", "bin_keys", (n,), [n, splats.depths, splats.extents, keys], defines=defines)
    _, order = argsort(device, keys, 8 * keys.dtype.itemsize)

    geometry = [n, width, height, order, splats.means2d, splats.conics, splats.extents, splats.opacities]
    counts = device.empty("tiles per Gaussian", n, np.uint32)
    device.launch("bin", "bin_count", (n,), [*geometry, counts], defines=defines)
    first_slots, m = exclusive_scan(device, counts, "intersections of Gaussians and tiles")

    tile_count = -(-width // tile_size) * -(-height // tile_size)
    tile_ranges = device.empty("tile ranges", (tile_count, 2), np.uint32)
    # A buffer cannot be empty: where nothing is visible one unused entry stands in.
    tiles = device.empty("tile keys", max(m, 1), np.uint32)
    slot_gauss = device.empty("intersections", max(m, 1), np.uint32)
    gauss_ids = device.empty("intersections", max(m, 1), np.uint32)
    device.launch("bin", "bin_emit", (n,), [*geometry, first_slots, tiles, slot_gauss], defines=defines)
    sorted_tiles, slots = argsort(device, tiles, tile_count.bit_length()) if m else (tiles, slot_gauss)
    device.launch("bin", "bin_ranges", (tile_count,), [m, tile_count, sorted_tiles, tile_ranges], defines=defines)
    if m:
        device.launch("bin", "bin_gather", (m,), [m, slots, slot_gauss, gauss_ids], defines=defines)
    return Bins(gauss_ids[:m], tile_ranges, order, first_slots, slots[:m], tile_size, width, height)
