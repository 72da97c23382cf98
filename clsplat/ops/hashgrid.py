"""Launch of the stage hashgrid (cl/hashgrid.cl)."""

from typing import Any

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import HashLevels
from clsplat.ops.sort import argsort

# Number of points per work-item of the forward kernel on a CPU.
CPU_POINTS = 512


def _defines(levels: HashLevels) -> dict[str, Any]:
    return {
        "RESOLUTIONS": ",".join(map(str, levels.resolutions)),
        "OFFSETS": ",".join(map(str, levels.offsets)),
    }


def hashgrid_fwd(device: Device, positions: Array, table: Array, levels: HashLevels) -> Array:
    """Interpolate the tables of all levels at points (Müller et al. 2022, section 3).

    Parameters
    ----------
    positions : (S, 3) real
        In [0, 1]; points outside are moved to the border.
    table : (E, 2) real
        Entries of all levels, one level after the other.
    levels : HashLevels

    Returns
    -------
    (S, 2 L) real
        Two features of each level.
    """
    points, count = positions.shape[0], CPU_POINTS if device.is_cpu else 1
    features = device.empty("features", (points, 2 * len(levels.resolutions)))
    group = 1 if device.is_cpu else device.group(64)
    size = -(-points // (count * group)) * group, len(levels.resolutions)
    arguments = [points, count, positions, table, features]
    device.launch("hashgrid", "hashgrid_fwd", size, arguments, defines=_defines(levels), group=(group, 1))
    return features


def hashgrid_bwd(device: Device, positions: Array, v_features: Array, levels: HashLevels) -> Array:
    """Gradient of `hashgrid_fwd` with respect to the table. It repeats to the bit.

    Parameters
    ----------
    positions, levels
        As given to `hashgrid_fwd`.
    v_features : (S, 2 L) real

    Returns
    -------
    v_table : (E, 2) real
    """
    points, defines = positions.shape[0], _defines(levels)
    v_table = device.empty("v_table", (levels.offsets[-1], 2))
    count = len(levels.resolutions)
    if device.is_cpu:
        parts = -(-device.cl_device.max_compute_units // count)
        arguments = [points, parts, positions, v_features, v_table]
        device.launch("hashgrid", "hashgrid_bwd", (count * parts,), arguments, defines=defines, group=(1,))
        return v_table
    device.launch("hashgrid", "hashgrid_zero", (v_table.size,), [v_table.size, v_table], defines=defines)
    for level in range(count):
        keys = device.empty("entries of corners", 8 * points, np.uint32)
        device.launch("hashgrid", "hashgrid_keys", (points,), [points, level, positions, keys], defines=defines)
        bits = (levels.offsets[level + 1] - levels.offsets[level] - 1).bit_length()
        sorted_keys, order = argsort(device, keys, bits)
        arguments = [8 * points, level, positions, v_features, sorted_keys, order, v_table]
        device.launch("hashgrid", "hashgrid_sums", (8 * points,), arguments, defines=defines)
    return v_table
