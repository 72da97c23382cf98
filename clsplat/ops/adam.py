"""Launch of the stage adam (cl/adam.cl)."""

from typing import Any

import numpy as np

from clsplat.device import Device
from clsplat.gaussians import SHAPES, Gaussians
from clsplat.stages import AdamStep

# Values per work-item of a CPU: several vectors, and enough work-items for any number of cores.
RUN = 64


def adam_step(
    device: Device,
    gaussians: Gaussians,
    gradients: Gaussians,
    first: Gaussians,
    second: Gaussians,
    step: AdamStep,
    sh_degree: int,
) -> None:
    """One step of Adam (Kingma and Ba 2015, algorithm 1), in place.

    Parameters
    ----------
    gaussians, gradients, first, second : Gaussians of N >= 1 rows
        Parameters, their gradients, and the running means of the gradients and of their squares.
    step : AdamStep
        Rates and constants.
    sh_degree : int
        Bands above it have had no gradient yet; their update would be 0 and is left out.
    """
    correction1, correction2 = 1 - step.beta1**step.iteration, 1 - step.beta2**step.iteration
    keep = np.array([step.beta1, step.beta2])
    run = RUN if device.is_cpu else 1
    for name in SHAPES:
        arrays = [getattr(c, name) for c in (gradients, gaussians, first, second)]
        total = arrays[0].size
        if name == "sh":
            stride, width, split = 3 * gaussians.sh.shape[1], 3 * (sh_degree + 1) ** 2, 3
            split_rate, rate = step.rates["sh0"], step.rates["sh_rest"]
        else:
            stride, width, split = run, run, 0
            split_rate = rate = step.rates[name]
        scalars: list[Any] = [split_rate / correction1, rate / correction1, 1 / correction2]
        scalars += [keep.astype(device.real), (1 - keep).astype(device.real), step.eps]
        device.launch("adam", "adam_step", (-(-total // stride),), [total, stride, width, split, *scalars, *arrays])
