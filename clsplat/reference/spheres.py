"""Twin of the stage spheres."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import Samples

Array = NDArray[Any]


def spheres(origins: Array, directions: Array, offsets: Array, occupied: Array, near: float) -> Samples:
    """Find the samples of rays between spheres. Arguments and result as for `clsplat.ops.spheres`."""
    cells, positions, deltas, counts = np.array(occupied.shape[::-1]), [np.zeros((0, 3))], [np.zeros(0)], []
    for origin, direction, offset in zip(origins, directions, offsets, strict=True):
        begin = origin + max(near, -origin @ direction) * direction
        first = 1 - 1 / max(float(np.linalg.norm(begin)), 1.0)
        edges = np.arange(cells[2] + 1) / cells[2]
        lo, hi = np.maximum(edges[:-1], first), edges[1:]
        at = lo + offset * (hi - lo)
        unit = _leaving(origin, direction, at)
        longitudes, latitudes = (
            np.arctan2(unit[:, 0], unit[:, 2]),
            np.arctan2(np.hypot(unit[:, 0], unit[:, 2]), unit[:, 1]),
        )
        x = np.stack([longitudes / (2 * np.pi) + 0.5, latitudes / np.pi, at], axis=1)
        cell = np.minimum((x * cells).astype(int), cells - 1)
        kept = (occupied[np.arange(cells[2]), cell[:, 1], cell[:, 0]] != 0) & (hi > first)
        ends = ((1 + w)[:, None] * _leaving(origin, direction, w) for w in (lo, hi))
        deltas.append(np.linalg.norm(np.subtract(*ends), axis=1)[kept])
        positions.append(x[kept])
        counts.append(int(kept.sum()))
    places = np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)
    rays_of = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
    return Samples(np.concatenate(positions), np.concatenate(deltas), rays_of, places, int(places[-1]))


def _leaving(origin: Array, direction: Array, depths: Array) -> Array:
    """Where a ray leaves the spheres of these depths, on the unit sphere, (W, 3)."""
    s, along = (1 - depths)[:, None], origin @ direction
    root = 1 - s**2 * ((origin - along * direction) ** 2).sum()
    return s * origin + (np.sqrt(np.maximum(root, 0)) - s * along) * direction
