"""Experiment: pruning removes every Gaussian."""

from dataclasses import replace

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.config import TrainConfig
from clsplat.device import Device
from clsplat.gaussians import logit
from clsplat.testing import synthetic_scene
from clsplat.training.contributions import Contributions
from clsplat.training.densify import STRATEGIES


def left_by_pruning(min_gaussians: int, n: int = 1000) -> int:
    """Number of Gaussians that one round of `adc` leaves of a scene whose Gaussians have all become transparent.

    Opacities decay like this in a training that receives no gradients.
    """
    config = TrainConfig(iterations=3000)
    config = replace(config, adc=replace(config.adc, min_gaussians=min_gaussians))
    gaussians = synthetic_scene(n)[0].astype(np.float32)
    gaussians.logit_opacities[:] = logit(np.float32(0.001))

    def unused(views: int, fraction: float) -> Contributions:
        raise AssertionError("adc surveys no photos")

    return len(STRATEGIES["adc"](config, 1.0, n).edit(600, gaussians, n, unused).gaussians)


def _all_pruned(device: Device) -> Found:
    return Found(
        [
            Figure("no minimum", left_by_pruning(0)),
            Figure("a minimum", left_by_pruning(TrainConfig().adc.min_gaussians)),
        ]
    )


ALL_PRUNED = Experiment(
    failure="everything pruned",
    source="INRIA #472, #482",
    remedy="pruning keeps a minimum number of Gaussians (`--adc.min-gaussians`)",
    test="tests/stability/test_densities.py::test_training_goes_on_where_everything_has_become_transparent",
    measure=_all_pruned,
    figure="Gaussians left of 1000 whose opacity is 0.001",
)
