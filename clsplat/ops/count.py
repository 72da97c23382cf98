"""Launch of the stage count (cl/count.cl)."""

from typing import Any

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.stages import AnySplats, Bins


def count_pairs(device: Device, splats: AnySplats, bins: Bins) -> tuple[Array, Array]:
    """Count the pairs of a splat and a pixel that compositing evaluates and draws.

    Parameters
    ----------
    splats : Splats
    bins : Bins of the same splats

    Returns
    -------
    evaluated : (H, W) uint32
        Number of splats of the tile's list whose box of extents contains the pixel, until the pixel is finished.
    accepted : (H, W) uint32
        Number of those that are drawn.
    """
    evaluated, accepted = (device.empty("pairs", (bins.height, bins.width), np.uint32) for _ in range(2))
    geometry = [splats.means2d, splats.conics, splats.extents, splats.opacities, bins.gauss_ids, bins.tile_ranges]
    arguments: list[Any] = [bins.width, bins.height, *geometry, evaluated, accepted]
    defines = {"TILE": bins.tile_size}
    device.launch("count", "count_pairs", (bins.height * bins.width,), arguments, defines=defines)
    return evaluated, accepted
