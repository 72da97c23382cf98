"""Twin of the stage voxels."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import NO_ROW, TV_EPS

Array = NDArray[Any]


def _corners(positions: Array, index: Array) -> tuple[Array, Array]:
    """Rows (S, 8) of the corners of each point's cell, and their weights (S, 8)."""
    cells = np.array(index.shape[::-1]) - 1
    x = np.clip(positions, 0, 1) * cells
    places = np.minimum(x.astype(np.int64), cells - 1)
    sides = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    weights = np.where(sides, (x - places)[:, None], 1 - (x - places)[:, None]).prod(axis=2)
    at = places[:, None] + sides
    return index[at[..., 2], at[..., 1], at[..., 0]], weights


def voxels_fwd(positions: Array, index: Array, table: Array) -> Array:
    """Interpolate a sparse grid. Arguments and result as for `clsplat.ops.voxels_fwd`."""
    rows, weights = _corners(positions, index)
    known = rows != NO_ROW
    values = table[np.where(known, rows, 0)]
    return np.einsum("sk,skf->sf", weights * known, values)


def voxels_bwd(positions: Array, index: Array, rows: int, v_features: Array) -> Array:
    """Gradient of `voxels_fwd`. Arguments and result as for `clsplat.ops.voxels_bwd`."""
    found, weights = _corners(positions, index)
    v_table = np.zeros((rows, v_features.shape[1]))
    known = found != NO_ROW
    np.add.at(v_table, found[known], (weights[:, :, None] * v_features[:, None])[known])
    return v_table


def voxels_tv(
    index: Array,
    corners: Array,
    table: Array,
    v_table: Array,
    weights: tuple[float, float],
    first: int,
    count: int,
) -> None:
    """Add the gradient of the total variation. Arguments as for `clsplat.ops.voxels_tv`."""
    places, gradient = np.stack(np.unravel_index(corners, index.shape)), np.zeros(table.shape)
    after, differences = np.full((3, len(table)), NO_ROW, np.int64), np.zeros((3, *table.shape))
    for axis, step in enumerate(np.eye(3, dtype=int)[::-1, :, None]):  # x is the last axis of `index`
        inside = (places + step < np.array(index.shape)[:, None]).all(axis=0)
        after[axis, inside] = index[tuple((places + step)[:, inside])]
        known = after[axis] != NO_ROW
        differences[axis, known] = table[after[axis, known]] - table[known]
    slopes = differences / np.sqrt((differences**2).sum(axis=0) + TV_EPS)
    for axis in range(3):
        known = after[axis] != NO_ROW
        gradient[known] -= slopes[axis, known]
        np.add.at(gradient, after[axis, known], slopes[axis, known])
    own = (first + np.arange(count)) % len(table)
    v_table[own] += np.where(np.arange(table.shape[1]) == 0, weights[0], weights[1]) * gradient[own]
