"""Twin of the stage bin: tests each splat against each row of tiles."""

import numpy as np

from clsplat.constants import ALPHA_MIN, EXTENT_SLACK
from clsplat.stages import AnySplats, Bins


def bin_splats(
    splats: AnySplats,
    width: int,
    height: int,
    tile_size: int,
    *,
    gradients: bool = True,
    scheme: str = "auto",
) -> Bins:
    """List the splats of each tile. Arguments and result as for `clsplat.ops.bin_splats`.

    The ellipse {alpha >= ALPHA_MIN} is cut at the first and at the last row of pixel centres of the tile. The splat
    belongs to the tile if this part spans a pixel centre of one of the tile's columns.
    """
    tiles_x, tiles_y = -(-width // tile_size), -(-height // tile_size)
    visible = splats.extents[:, 0] > 0
    rank = np.argsort(np.argsort(np.where(visible, splats.depths, np.inf), kind="stable"))
    tiles: list[int] = []
    slot_gauss: list[int] = []
    first_slots = [0]
    for g in range(len(visible)):
        if visible[g]:
            cells = _tiles_of(splats, g, width, height, tile_size)
            tiles += [ty * tiles_x + tx for ty, tx in cells]
            slot_gauss += [g] * len(cells)
        first_slots.append(len(tiles))
    gauss, tile = (np.array(a, dtype=np.uint32) for a in (slot_gauss, tiles))
    slots = np.lexsort((rank[gauss], tile)).astype(np.uint32)
    sorted_tiles = tile[slots]
    edges = np.searchsorted(sorted_tiles, np.arange(tiles_x * tiles_y + 1))
    ranges = np.stack([edges[:-1], edges[1:]], axis=1).astype(np.uint32)
    first, slot = (np.array(first_slots, np.uint32), slots) if gradients else (None, None)
    return Bins(gauss[slots], ranges, first, slot, tile_size, width, height)


def _tiles_of(splats: AnySplats, g: int, width: int, height: int, tile_size: int) -> list[tuple[int, int]]:
    (mx, my), (ex, ey) = splats.means2d[g], splats.extents[g]
    a, b, c = splats.conics[g]
    r2 = 2 * (np.log(splats.opacities[g] / ALPHA_MIN) + EXTENT_SLACK)
    rows = max(0, int(np.ceil(my - ey - 0.5))), min(height - 1, int(np.floor(my + ey - 0.5)))
    cells = []
    for ty in range(rows[0] // tile_size, rows[1] // tile_size + 1):
        lo = max(ty * tile_size + 0.5 - my, -ey)
        hi = min(min((ty + 1) * tile_size, height) - 0.5 - my, ey)
        if lo > hi:
            continue
        # dx has its extremes at dy = -+(b/c) ex, or at the nearer end of [lo, hi].
        x_min, x_max = -ex, ex
        if a > 0:  # otherwise the splat has a whole box
            left, right = np.clip(b / c * ex, lo, hi), np.clip(-b / c * ex, lo, hi)
            x_min = (-b * left - np.sqrt(a * r2 * max(1 - (left / ey) ** 2, 0))) / a
            x_max = (-b * right + np.sqrt(a * r2 * max(1 - (right / ey) ** 2, 0))) / a
        first = max(0, int(np.ceil(mx + x_min - 0.5)))
        last = min(width - 1, int(np.floor(mx + x_max - 0.5)))
        if first <= last:
            cells += [(ty, tx) for tx in range(first // tile_size, last // tile_size + 1)]
    return cells
