"""Launch of the stage voxels (cl/voxels.cl)."""

from typing import Any

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import TV_EPS
from clsplat.ops.sort import argsort


def _defines(table: Array) -> dict[str, Any]:
    return {"FEATURES": table.shape[1], "TV_EPS": TV_EPS}


def _cells(index: Array) -> list[int]:
    """Cells along x, y and z."""
    return [corners - 1 for corners in index.shape[::-1]]


def voxels_fwd(device: Device, positions: Array, index: Array, table: Array) -> Array:
    """Interpolate the corners of a sparse grid at points (Fridovich-Keil et al. 2022, section 3.1).

    Parameters
    ----------
    positions : (S, 3) real
        In [0, 1]; points outside are moved to the border.
    index : (nz + 1, ny + 1, nx + 1) uint32
        Row in `table` of each corner [z, y, x] of the cells. Those without one, whose features are 0, have
        `clsplat.field_stages.NO_ROW`. A grid is closed if its last corners along x have the rows of the first ones.
    table : (M, F) real

    Returns
    -------
    (S, F) real
    """
    points = positions.shape[0]
    features = device.empty("features", (points, table.shape[1]))
    arguments = [points, *_cells(index), positions, index, table, features]
    device.launch("voxels", "voxels_fwd", (points,), arguments, defines=_defines(table))
    return features


def voxels_bwd(device: Device, positions: Array, index: Array, rows: int, v_features: Array) -> Array:
    """Gradient of `voxels_fwd` with respect to the table. It repeats to the bit.

    Parameters
    ----------
    positions, index
        As given to `voxels_fwd`.
    rows : int
        Number of rows of the table.
    v_features : (S, F) real

    Returns
    -------
    v_table : (rows, F) real
    """
    points, cells, defines = positions.shape[0], _cells(index), _defines(v_features)
    v_table = device.empty("v_table", (rows, v_features.shape[1]))
    if device.is_cpu:
        parts = device.cl_device.max_compute_units
        arguments = [points, *cells, rows, parts, positions, index, v_features, v_table]
        device.launch("voxels", "voxels_bwd", (parts,), arguments, defines=defines, group=(1,))
        return v_table
    device.launch("voxels", "voxels_zero", (v_table.size,), [v_table.size, v_table], defines=defines)
    keys = device.empty("rows of corners", 8 * points, np.uint32)
    arguments = [points, *cells, rows, positions, index, keys]
    device.launch("voxels", "voxels_keys", (points,), arguments, defines=defines)
    sorted_keys, order = argsort(device, keys, rows.bit_length())
    arguments = [8 * points, *cells, rows, positions, v_features, sorted_keys, order, v_table]
    device.launch("voxels", "voxels_sums", (8 * points,), arguments, defines=defines)
    return v_table


def voxels_tv(
    device: Device,
    index: Array,
    corners: Array,
    table: Array,
    v_table: Array,
    weights: tuple[float, float],
    first: int,
    count: int,
) -> None:
    """Add the gradient of the total variation to some rows, in place (Fridovich-Keil et al. 2022, equation 3).

    Parameters
    ----------
    index, table
        As given to `voxels_fwd`.
    corners : (M,) uint32
        Place of the corner of each row in the flat `index`; the first one, where a grid is closed.
    v_table : (M, F) real
        Gradient, to which is added.
    weights : two floats
        Of the sums over corners: for the first feature, and for the others.
    first, count : int
        The rows first to first + count, at most M of them; after the last row follows the first one.
    """
    rows = table.shape[0]
    scalars = [rows, *_cells(index), first, count, float(weights[0]), float(weights[1])]
    arguments = [*scalars, index, corners, table, v_table]
    device.launch("voxels", "voxels_tv", (count,), arguments, defines=_defines(table))
