"""Launch of the stage adam (cl/adam.cl)."""

from typing import Any

from clsplat.device import Device
from clsplat.gaussians import SHAPES, Gaussians
from clsplat.stages import AdamStep
from clsplat.structs import adam_struct

# Number of values per work-item: one vector.
RUN = 16


def adam_step(
    device: Device,
    gaussians: Gaussians,
    gradients: Gaussians,
    first: Gaussians,
    second: Gaussians,
    step: AdamStep,
) -> None:
    """Take one step of Adam (Kingma and Ba 2015, algorithm 1), in place.

    Parameters
    ----------
    gaussians, gradients, first, second : Gaussians of N >= 1 rows
        Parameters, their gradients, and the running means of the gradients and of their squares.
    step : AdamStep
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
        scalars: list[Any] = [total, stride, width, split, *rates, *penalties, struct]
        device.launch("adam", "adam_step", (-(-total // stride),), [*scalars, *arrays])
