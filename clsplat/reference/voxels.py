"""Twin of the stage voxels."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import NO_ROW, TV_EPS

Array = NDArray[Any]


def _corners(positions: Array, index: Array) -> tuple[Array, Array]:
    """Rows (S, 8) of the corners of each point's cell, and their weights (S, 8)."""
    cells = len(index) - 1
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
    known = index != NO_ROW
    values = np.where(known[..., None], table[np.where(known, index, 0)], 0)
    differences = np.zeros((3, *values.shape))
    for axis in range(3):
        # The corner after the last one of an axis does not exist.
        after = np.roll(known, -1, axis=2 - axis)
        np.moveaxis(after, 2 - axis, 0)[-1] = False
        step = np.roll(values, -1, axis=2 - axis) - values
        differences[axis] = np.where((known & after)[..., None], step, 0)
    slopes = differences / np.sqrt((differences**2).sum(axis=0) + TV_EPS)
    gradient = -slopes.sum(axis=0)
    for axis in range(3):
        gradient += np.roll(slopes[axis], 1, axis=2 - axis)
    own = (first + np.arange(count)) % len(table)
    scale = np.where(np.arange(table.shape[1]) == 0, weights[0], weights[1])
    v_table[own] += scale * gradient.reshape(-1, table.shape[1])[corners[own]]
