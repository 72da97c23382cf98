"""Twin of the stage hashgrid."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import HashLevels

Array = NDArray[Any]

PRIMES = np.array([1, 2654435761, 805459861], np.uint64)
"""Factors of the hash by axis (Müller et al. 2022, section 3)."""


def corners(positions: Array, resolution: int, size: int) -> tuple[Array, Array]:
    """Entries (S, 8) of the corners of each point's cell in one level, and their weights (S, 8)."""
    x = np.clip(positions, 0, 1) * resolution
    cells = np.minimum(x.astype(np.int64), resolution - 1)
    sides = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    weights = np.where(sides, (x - cells)[:, None], 1 - (x - cells)[:, None]).prod(axis=2)
    places = (cells[:, None] + sides).astype(np.uint64)
    if (resolution + 1) ** 3 <= size:
        return places @ np.array([1, resolution + 1, (resolution + 1) ** 2], np.uint64), weights
    products = places * PRIMES & np.uint64(0xFFFFFFFF)
    return np.bitwise_xor.reduce(products, axis=2) % np.uint64(size), weights


def hashgrid_fwd(positions: Array, table: Array, levels: HashLevels) -> Array:
    """Interpolate the tables of all levels. Arguments and result as for `clsplat.ops.hashgrid_fwd`."""
    features = []
    for level, resolution in enumerate(levels.resolutions):
        own = table[levels.offsets[level] : levels.offsets[level + 1]]
        entries, weights = corners(positions, resolution, len(own))
        features.append(np.einsum("sk,skf->sf", weights, own[entries]))
    return np.concatenate(features, axis=1)


def hashgrid_bwd(positions: Array, v_features: Array, levels: HashLevels) -> Array:
    """Gradient of `hashgrid_fwd`. Arguments and result as for `clsplat.ops.hashgrid_bwd`."""
    v_table = np.zeros((levels.offsets[-1], 2))
    for level, resolution in enumerate(levels.resolutions):
        begin, end = levels.offsets[level], levels.offsets[level + 1]
        entries, weights = corners(positions, resolution, end - begin)
        v = v_features[:, None, 2 * level : 2 * level + 2]
        np.add.at(v_table[begin:end], entries, weights[:, :, None] * v)
    return v_table
