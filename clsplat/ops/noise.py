"""Launch of the stage noise (cl/noise.cl)."""

import numpy as np

from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.stages import GATE_OPACITY, GATE_SLOPE


def add_noise(device: Device, gaussians: Gaussians, size: float, seed: int, iteration: int) -> None:
    """Add noise to the means, in place, shaped by each Gaussian's covariance and reduced by its opacity.

    Parameters
    ----------
    gaussians : Gaussians of N >= 1 rows
    size : float
        Factor on the covariance times normal random numbers, in inverse world units.
    seed, iteration : int
        Each pair yields different random numbers. The seed has 64 bits, the iteration 32.
    """
    n, g = len(gaussians), gaussians
    key = np.array([seed & 0xFFFFFFFF, seed >> 32], np.uint32)
    arrays = [g.log_scales, g.quats, g.logit_opacities, g.means]
    defines = {"GATE_SLOPE": GATE_SLOPE, "GATE_OPACITY": GATE_OPACITY}
    scalars = [n, key, np.uint32(iteration), float(size)]
    device.launch("noise", "add_noise", (n,), [*scalars, *arrays], defines=defines)
