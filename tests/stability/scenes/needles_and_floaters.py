"""Experiments: needles, and Gaussians that a camera nearly touches."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from real_scenes import SHORT, load

from clsplat.bench.captures import arc
from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.trained import held_out, trained
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.constants import NEAR
from clsplat.dataset.near_planes import with_near_planes
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.pruning.prices import measure_removals
from clsplat.renderer import Renderer
from clsplat.scene import Scene

NEEDLE = 1.1
"""Effective rank below which a Gaussian counts as a needle (Hyung et al. 2024). A line has rank 1, a disc 2."""

ARC = 0.2
"""Fraction of the photos that are held out at the end of the path, as in `clsplat bench captures`."""

SUPPORT = 3
"""Number of photos that must show a Gaussian in the experiment on photos at the end of the path."""

DROPOUT = 0.2
"""Fraction of the Gaussians left out at the end of a training, as with few photos (`--few.dropout`)."""

SEEDS = (0, 1, 2)

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


def shown_by(gaussians: Gaussians, scene: Scene, config: TrainConfig, device: Device) -> np.ndarray:
    """(N,) Number of training photos of which each Gaussian makes up half a pixel or more."""
    renderer = Renderer(device, config.render, BACKGROUNDS[config.data.background])
    count = np.zeros(len(gaussians), int)
    for measured in measure_removals(renderer, gaussians, with_near_planes(scene).train, None):
        count += measured.removal.weights > 0.5
    return count


def _outermost(device: Device, data: Path) -> Found:
    scene, config = load(data, "castle_p30", replace(SHORT, strategy="error", max_gaussians=8000, iterations=1500))
    scene = arc(scene, ARC)
    bare = replace(config, error=replace(config.error, opacity_penalty=0.0))
    scores: dict[str, list[float]] = {}
    for seed in SEEDS:
        for label, variant in (
            (f"--near {NEAR}, no penalty", replace(bare, render=replace(config.render, near=NEAR))),
            ("near planes", bare),
            ("near planes and the penalty: the default", config),
            (f"the default with --dropout {DROPOUT}", replace(config, dropout=DROPOUT)),
        ):
            gaussians = trained(scene, replace(variant, seed=seed), device)
            scores.setdefault(label, []).append(held_out(gaussians, with_near_planes(scene), variant, device))
            if variant is config:
                seen = gaussians.take(np.flatnonzero(shown_by(gaussians, scene, config, device) >= SUPPORT))
                label = f"the default without what fewer than {SUPPORT} photos show"
                scores.setdefault(label, []).append(held_out(seen, with_near_planes(scene), config, device))
    return Found([Figure(label, float(np.mean(found)), "dB") for label, found in scores.items()])


FLOATERS = Experiment(
    failure="floaters near cameras",
    source="a Gaussian that a camera nearly touches spreads over its whole image",
    remedy="near planes at three tenths of the depth of each photo's nearest points",
    test="tests/stability/test_views.py::test_gaussians_next_to_a_camera_are_not_drawn",
    measure=_floaters,
    figure="PSNR of the worst held-out photo of castle_p30, 96x64, 600 iterations of `error` with 6000 Gaussians",
)

OUTERMOST = Experiment(
    failure="floaters beyond the last photo",
    source="what few photos show may fit them with Gaussians in front of the next camera",
    remedy="near planes for each photo, a penalty of opacity (`--error.opacity-penalty`), and what no photo shows is "
    "removed",
    test="tests/stability/test_views.py::test_gaussians_that_no_photo_shows_are_removed",
    measure=_outermost,
    figure=f"PSNR of the photos at the end of the path ({ARC:.0%}, none of them trained on) of castle_p30, 96x64, "
    f"1500 iterations of `error` with 8000 Gaussians, mean of {len(SEEDS)} seeds",
)

EFFECTIVE_RANK = Experiment(
    failure="needles",
    source="Hyung et al. 2024, effective rank",
    remedy="a regulariser of the effective rank (`--optim.erank-penalty`)",
    test="tests/stability/test_views.py::test_the_regulariser_leaves_fewer_needles",
    measure=effective_rank,
    figure=f"Gaussians with an effective rank below {NEEDLE}; castle_p30, 96x64, 500 iterations",
)
