"""Launch of the stage median (cl/median.cl)."""

from typing import Any

import numpy as np

from clsplat.device import Device
from clsplat.ops.composite import directions_of, packed, ray_charts, variant
from clsplat.stages import AnySplats, Bins


def median_splats(device: Device, splats: AnySplats, bins: Bins) -> Any:
    """The splat of each pixel at which the transmittance falls to 1/2 or below.

    Parameters
    ----------
    splats : Splats or RaySplats
    bins : Bins of the same splats

    Returns
    -------
    (H, W) int32
        Indices of splats; -1 where the transmittance stays above 1/2. It has no gradient.
    """
    ids = device.empty("median splats", (bins.height, bins.width), np.int32)
    pack = packed(device, splats, bins, variant(device))
    arguments: list[Any] = [bins.width, bins.height, pack, bins.gauss_ids, bins.tile_ranges, ids]
    defines = {"TILE": bins.tile_size, "CHANNELS": splats.colors.shape[1], "RAYS": ray_charts(splats)}
    arguments += directions_of(splats)
    device.launch("median", "median_splats", (bins.height * bins.width,), arguments, defines=defines)
    return ids
