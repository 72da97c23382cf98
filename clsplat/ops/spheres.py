"""Launch of the stage spheres (cl/spheres.cl)."""

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import Samples
from clsplat.ops.march import no_samples
from clsplat.ops.scan import exclusive_scan


def spheres(
    device: Device, origins: Array, directions: Array, offsets: Array, occupied: Array, near: float
) -> Samples:
    """Find the samples of rays between spheres around the unit ball (Fridovich-Keil et al. 2022, "Unbounded scenes").

    Parameters
    ----------
    origins, directions : (R, 3) real
        In the coordinates of the field. Directions have length 1.
    offsets : (R,) real
        Place of each sample between two spheres, in [0, 1): the samples of a ray are stratified if it is random.
    occupied : (K, J, I) uint8
        Not 0 where a cell [depth, latitude, longitude] may hold anything. Depths are 1 - 1/r, for the radius r.
    near : float
        Distance at which rays begin.

    Returns
    -------
    Samples
        Positions are (longitude / 2 pi + 1/2, angle from the y axis / pi, depth). Lengths are those of the contracted
        ray (Barron et al. 2022, equation 10). At most one sample for each depth.

    Raises
    ------
    DeviceError
        If they do not fit the device's memory.
    """
    rays = origins.shape[0]
    shared = [rays, *occupied.shape[::-1], float(near), origins, directions, offsets, occupied]
    counts = device.empty("samples of rays", rays, np.uint32)
    device.launch("spheres", "spheres_count", (rays,), [*shared, counts])
    first, total = exclusive_scan(device, counts, "samples of rays")
    if not total:
        return no_samples(device, first)
    positions, deltas = device.empty("positions", (total, 3)), device.empty("deltas", total)
    rays_of = device.empty("rays of samples", total, np.uint32)
    device.launch("spheres", "spheres_samples", (rays,), [*shared, first, positions, deltas, rays_of])
    return Samples(positions, deltas, rays_of, first, total)
