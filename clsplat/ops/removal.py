"""Launch of the stage removal (cl/removal_cpu.cl, cl/removal_gpu.cl)."""

from typing import Any

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.ops.bin import check_slots
from clsplat.ops.composite import composite_until, directions_of, gpu_batch, lanes_of, packed, ray_charts, variant
from clsplat.stages import AnySplats, Bins, Removal


def removal(
    device: Device, splats: AnySplats, bins: Bins, background: Any, residuals: Any = None, mask: Any = None
) -> Removal:
    """The sums of `removal_sums`, with the same arguments, on the host."""
    return Removal.of(removal_sums(device, splats, bins, background, residuals, mask).get())


def removal_sums(
    device: Device,
    splats: AnySplats,
    bins: Bins,
    background: Any,
    residuals: Any = None,
    mask: Any = None,
) -> Array:
    """Change of an image's squared error if a single splat is removed or changes its colour.

    Parameters
    ----------
    splats : Splats with C colour channels
    bins : Bins of the same splats, made with gradients
    background : (C,) array on the host
    residuals : (H, W, C) array on the host or the device, optional
        Image minus target. Default: 0.
    mask : (H, W) array of bool on the host, or of uint8 on the device, optional
        True where pixels count. Default: everywhere.

    Returns
    -------
    (N, 6 + C) real
        The fields of `Removal` as columns, on the device.

    Raises
    ------
    InputError
        If the lists were made without gradients.
    """
    check_slots(bins)
    n, channels = splats.colors.shape
    m, (tiles, _) = bins.gauss_ids.shape[0], bins.tile_ranges.shape
    size = bins.height, bins.width
    records = device.empty("prices per intersection", (max(m, 1), 6 + channels))
    sums = device.empty("prices", (n, 6 + channels))
    if residuals is None:
        residuals = device.zeros("residuals", (*size, channels))
    pixels = [
        residuals if isinstance(residuals, Array) else device.upload("residuals", residuals),
        mask if isinstance(mask, Array) else device.upload("mask", np.ones(size) if mask is None else mask, np.uint8),
    ]
    stage = "removal_cpu" if device.is_cpu else "removal_gpu"
    pack = packed(device, splats, bins, variant(device))
    defines = {"TILE": bins.tile_size, "CHANNELS": channels, "RAYS": ray_charts(splats)}
    if device.is_cpu:
        group, behind = 1, device.constant("background", background)
        defines |= {"LANES": lanes_of(device, bins)}
    else:
        stop = device.model["TRANSMITTANCE_MIN"] * (1 - device.model["ALPHA_MAX"])  # see cl/removal_cpu.cl
        group, behind = gpu_batch(device), composite_until(device, splats, pack, bins, background, stop)
        defines |= {"STOP": stop, "BATCH": group, "SUBGROUPS": int(device.subgroup_size > 0)}
    lists = [bins.gauss_ids, bins.tile_ranges, bins.slots]
    arguments = [bins.width, bins.height, pack, *lists, behind, *pixels, records, *directions_of(splats)]
    device.launch(stage, "removal", (tiles * group,), arguments, defines=defines, group=(group,))
    arguments = [n, bins.first_slots, records, sums]
    device.launch(stage, "removal_sum", (n,), arguments, defines=defines)
    return sums


def removal_residuals(device: Device, image: Array, photo: Array, *, clamped: bool = False) -> Array:
    """Residuals of an image.

    Parameters
    ----------
    image : (H, W, 3) real
    photo : (H, W, 3) uint8
    clamped : bool
        Clamp the image to [0, 1] as a screen does: values above white are then no error.

    Returns
    -------
    (H, W, 3) real
        Image minus photo / 255.
    """
    residuals = device.empty("residuals", image.shape)
    device.launch(
        "removal_residuals", "removal_residuals", (image.size,), [image.size, int(clamped), image, photo, residuals]
    )
    return residuals
