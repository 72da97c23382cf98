"""Experiments: needles, and Gaussians that a camera nearly touches."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from real_scenes import load

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.trained import held_out, trained
from clsplat.config import TrainConfig
from clsplat.constants import NEAR
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.scene import Scene

NEEDLE = 1.1
"""Effective rank below which a Gaussian counts as a needle (Hyung et al. 2024). A line has rank 1, a disc 2."""

ERANK_PENALTY = 0.01
"""Weight of the regulariser in the experiment on needles."""


def effective_ranks(gaussians: Gaussians) -> np.ndarray:
    """(N,) Effective ranks: exp of the entropy of the normalised squared scales (Hyung et al. 2024)."""
    squares = gaussians.scales.astype(np.float64) ** 2
    shares = squares / squares.sum(axis=1, keepdims=True)
    return np.asarray(np.exp(-(shares * np.log(np.maximum(shares, 1e-300))).sum(axis=1)))


def effective_rank(device: Device, data: Path) -> Found:
    """Share of needles, and PSNR of held-out photos, without the regulariser and with it."""
    scene, config = load(data, "castle_p30")
    shares, scores = [], []
    for label, penalty in (("no regulariser", 0.0), (f"--optim.erank-penalty {ERANK_PENALTY}", ERANK_PENALTY)):
        asked = replace(config, optim=replace(config.optim, erank_penalty=penalty))
        gaussians = trained(scene, asked, device)
        shares.append(Figure(label, 100 * float((effective_ranks(gaussians) < NEEDLE).mean()), "%"))
        scores.append(Figure(f"{label}, held-out photos", held_out(gaussians, scene, asked, device), "dB"))
    return Found([*shares, *scores])


def worst_view(gaussians: Gaussians, scene: Scene, config: TrainConfig, near: float | None, device: Device) -> float:
    """PSNR, dB, of the worst held-out photo, rendered with the near plane `near`."""
    asked = replace(config, render=replace(config.render, near=near))
    return min(held_out(gaussians, replace(scene, test=[view]), asked, device) for view in scene.test)


def _floaters(device: Device, data: Path) -> Found:
    scene, config = load(data, "castle_p30")
    config = replace(config, strategy="error", max_gaussians=6000, iterations=600)
    figures = []
    for label, trains, draws in (
        (f"--near {NEAR}", NEAR, NEAR),
        (f"trained with --near {NEAR}, drawn with the default", NEAR, None),
        ("trained and drawn with the default", None, None),
    ):
        asked = replace(config, render=replace(config.render, near=trains))
        figures.append(Figure(label, worst_view(trained(scene, asked, device), scene, config, draws, device), "dB"))
    return Found(figures)


FLOATERS = Experiment(
    failure="floaters near cameras",
    source="a Gaussian that a camera nearly touches spreads over its whole image",
    remedy="a near plane at a tenth of the depth of a dataset's nearest points",
    test="tests/stability/test_views.py::test_gaussians_next_to_a_camera_are_not_drawn",
    measure=_floaters,
    figure="PSNR of the worst held-out photo of castle_p30, 96x64, 600 iterations of `error` with 6000 Gaussians",
)

EFFECTIVE_RANK = Experiment(
    failure="needles",
    source="Hyung et al. 2024, effective rank",
    remedy="a regulariser of the effective rank (`--optim.erank-penalty`)",
    test="tests/stability/test_views.py::test_the_regulariser_leaves_fewer_needles",
    measure=effective_rank,
    figure=f"Gaussians with an effective rank below {NEEDLE}; castle_p30, 96x64, 500 iterations",
)
