"""Experiment: Gaussians that MCMC leaves in the scene although no pixel shows them."""

from dataclasses import replace
from pathlib import Path

from real_scenes import load

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.trained import trained
from clsplat.device import Device
from clsplat.pruning.prices import without_invisible

CAP = 5000
"""Maximal number of Gaussians."""


def _dead(device: Device, data: Path) -> Found:
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


DEAD = Experiment(
    failure="dead Gaussians left by MCMC",
    source="gsplat #822",
    remedy="Gaussians with an opacity below 1/255, which no pixel can show, are not saved",
    test="tests/stability/test_densities.py::test_invisible_gaussians_are_not_saved",
    measure=_dead,
    figure=f"Gaussians with an opacity below 0.005, `mcmc` with {CAP} on fern",
)
