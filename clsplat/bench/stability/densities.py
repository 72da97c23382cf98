"""Experiments on Gaussians that vanish, or that stay though nobody sees them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.trained import load, trained
from clsplat.config import TrainConfig
from clsplat.device import Device
from clsplat.gaussians import logit
from clsplat.pruning.prices import without_invisible
from clsplat.testing import synthetic_scene
from clsplat.training.contributions import Contributions
from clsplat.training.densify import STRATEGIES

CAP = 5000


def left_by_pruning(min_gaussians: int, n: int = 1000) -> int:
    """Gaussians that a round of adc leaves of a scene that has become transparent, as one without gradients does."""
    config = TrainConfig()
    config = replace(config, adc=replace(config.adc, min_gaussians=min_gaussians))
    gaussians = synthetic_scene(n)[0].astype(np.float32)
    gaussians.logit_opacities[:] = logit(np.float32(0.001))

    def unused(views: int) -> Contributions:
        raise AssertionError("adc looks at no photos")

    return len(STRATEGIES["adc"](config, 1.0, n).edit(600, gaussians, unused).gaussians)


def _all_pruned(device: Device, data: Path | None) -> Found:
    return Found(
        [
            Figure("no minimum", left_by_pruning(0)),
            Figure("a minimum", left_by_pruning(TrainConfig().adc.min_gaussians)),
        ]
    )


def _dead(device: Device, data: Path | None) -> Found:
    scene, config = load(data, "fern")
    config = replace(config, strategy="mcmc", max_gaussians=CAP)
    gaussians = trained(scene, config, device)
    kept = without_invisible(gaussians)
    return Found(
        [
            Figure("as trained", 100 * float((gaussians.opacities < config.mcmc.opacity_min).mean()), "%"),
            Figure("as saved", 100 * float((kept.opacities < config.mcmc.opacity_min).mean()), "%"),
        ]
    )


ALL_PRUNED = Experiment(
    failure="everything pruned",
    source="INRIA #472, #482",
    remedy="pruning leaves a minimum, `--adc.min-gaussians`",
    test="tests/stability/test_densities.py::test_training_goes_on_where_everything_has_become_transparent",
    measure=_all_pruned,
    figure="Gaussians left of 1000 whose opacity is 0.001",
)

DEAD = Experiment(
    failure="dead Gaussians left by MCMC",
    source="gsplat #822",
    remedy="Gaussians that no pixel can show, of opacities below 1/255, are not saved",
    test="tests/stability/test_densities.py::test_what_no_pixel_shows_is_not_saved",
    measure=_dead,
    figure=f"Gaussians of an opacity below 0.005, `mcmc` with {CAP} on fern",
    needs_data=True,
)
