"""Launch of the stage march (cl/march.cl)."""

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import Marching, Samples
from clsplat.ops.scan import exclusive_scan


def march(
    device: Device, origins: Array, directions: Array, offsets: Array, occupied: Array, marching: Marching
) -> Samples:
    """Find the samples of rays that lie in occupied cells.

    Parameters
    ----------
    origins, directions : (R, 3) real
        In the coordinates of the field: those of the unit cube, or, with a contraction, those in which the unit ball
        keeps its shape. Directions have length 1.
    offsets : (R,) real
        Place of the first sample in its step, in [0, 1): the samples of a ray are stratified if it is random.
    occupied : (G, G, G) uint8
        Not 0 where a cell [z, y, x] of the unit cube may hold anything.
    marching : Marching

    Returns
    -------
    Samples

    Raises
    ------
    DeviceError
        If they do not fit the device's memory.
    """
    rays, cells = origins.shape[0], occupied.shape[0]
    defines = {"CONTRACTED": int(marching.contracted)}
    scalars = [rays, cells, float(marching.step), float(marching.cone), float(marching.near), float(marching.far)]
    shared = [*scalars, origins, directions, offsets, occupied]
    counts = device.empty("samples of rays", rays, np.uint32)
    device.launch("march", "march_count", (rays,), [*shared, counts], defines=defines)
    first, total = exclusive_scan(device, counts, "samples of rays")
    if not total:
        return no_samples(device, first)
    positions, deltas = device.empty("positions", (total, 3)), device.empty("deltas", total)
    rays_of = device.empty("rays of samples", total, np.uint32)
    device.launch("march", "march_samples", (rays,), [*shared, first, positions, deltas, rays_of], defines=defines)
    return Samples(positions, deltas, rays_of, first, total)


def no_samples(device: Device, first: Array) -> Samples:
    """One sample of no length, which no ray has: drivers refuse empty buffers."""
    positions, deltas = device.upload("positions", np.zeros((1, 3))), device.upload("deltas", np.zeros(1))
    return Samples(positions, deltas, device.upload("rays of samples", [0], np.uint32), first, 0)
