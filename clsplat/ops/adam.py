"""Launch of the stage adam (cl/adam.cl)."""

from typing import Any

from pyopencl.array import Array

from clsplat.device import Device
from clsplat.gaussians import SHAPES, Gaussians
from clsplat.stages import AdamStep
from clsplat.structs import RATES, adam_struct

# Number of values per work-item: one vector.
RUN = 16

# Number of vectors per work-item in long arrays on a CPU.
CPU_RUNS = 64


def adam_step(
    device: Device,
    gaussians: Gaussians,
    gradients: Gaussians,
    first: Gaussians,
    second: Gaussians,
    step: AdamStep,
    extents: Array | None = None,
) -> None:
    """Take one step of Adam (Kingma and Ba 2015, algorithm 1), in place.

    Parameters
    ----------
    gaussians, gradients, first, second : Gaussians of N >= 1 rows
        Parameters, their gradients, and the running means of the gradients and of their squares.
    step : AdamStep
    extents : (N, 2) array, optional
        Those of the splats. Penalties are added only where they are above 0. Default: everywhere.
    """
    struct = adam_struct(step, device.real)
    for name in SHAPES:
        arrays = [getattr(c, name) for c in (gaussians, gradients, first, second)]
        total = arrays[0].size
        if name == "sh":
            stride, width, split = 3 * gaussians.sh.shape[1], 3 * (step.sh_degree + 1) ** 2, 3
            rates = [struct["sh0"], struct["sh_rest"]]
        else:
            # A work-item takes whole rows, because the effective rank depends on all three scales.
            run = RUN if name != "log_scales" else 3 * (RUN // 3)
            stride, width, split = run, run, 0
            rates = [struct[name]] * 2
        fields = ("logit_opacities", "log_scales", "log_scales")
        penalties = [float(weight) * (name == field) for weight, field in zip(step.penalties, fields, strict=True)]
        scalars: list[Any] = [total, stride, width, split, *rates, *penalties, struct, total // len(gaussians)]
        device.launch("adam", "adam_step", (-(-total // stride),), [*scalars, extents, *arrays])


def adam_array(
    device: Device,
    parameters: Array,
    gradients: Array,
    first: Array,
    second: Array,
    rate: float,
    step: AdamStep,
    *,
    sparse: bool = False,
) -> None:
    """Take one step of Adam on an array of parameters, in place.

    Parameters
    ----------
    parameters, gradients, first, second : (P,) real
        As for `adam_step`, of any one shape.
    rate : float
        Learning rate.
    step : AdamStep
        Its number and constants; rates by field, degree and penalties are not used.
    sparse : bool
        Whether parameters whose gradient is 0, and their moments, stay as they are (Müller et al. 2022, section 4).
    """
    total, struct = parameters.size, adam_struct(step._replace(rates=dict.fromkeys(RATES, rate)), device.real)
    run = RUN * CPU_RUNS if device.is_cpu else RUN
    arguments = [total, run, int(sparse), struct["means"], struct, parameters, gradients, first, second]
    device.launch("adam", "adam_array", (-(-total // run),), arguments)
