"""Experiments on what no photo shows: colours from other directions, needles that only a few photos hide."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.small import CONFIG, small_scene, with_train
from clsplat.bench.stability.trained import held_out, trained
from clsplat.config import TrainConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.reference.sh import sh_basis
from clsplat.scene import Scene, View

NEEDLE = 1.1
"""Effective rank below which a Gaussian counts as a needle (Hyung et al. 2024): 1 is a line, 2 a disc."""

ERANK_PENALTY = 0.01
"""Weight of the regulariser in the row on needles."""


def one_side(scene: Scene) -> Scene:
    """The photos of a quarter of the circle, each with a highlight of its own: what is seen depends on the view."""

    def lit(view: View, rng: np.random.Generator) -> View:
        return replace(view, image=np.clip(view.image * rng.uniform(0.8, 1.2), 0, 255).astype(np.uint8))

    scene = with_train(scene, lit)
    return replace(scene, train=scene.train[:4], test=scene.test[1:])


def color_range(gaussians: Gaussians, viewed_from: np.ndarray) -> float:
    """By how much colours differ from SH0 in directions that no photo has: the 95th percentile over Gaussians and
    directions of the largest channel; `viewed_from` (3,) is the middle of the photos' directions."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    unseen = directions[directions @ viewed_from > 0]  # from the camera to the Gaussian: the camera is opposite
    basis = sh_basis(unseen, gaussians.sh_degree)[:, 1:]
    change = np.einsum("dk,nkc->ndc", basis, gaussians.sh[:, 1:].astype(np.float64))
    return float(np.percentile(np.abs(change).max(axis=2), 95))


def unseen_colors(degree: int, device: Device) -> tuple[float, float]:
    """Range of the colours on the unseen side after a training of so many bands, and PSNR of its photos."""
    scene = one_side(small_scene(device))
    config = replace(CONFIG, init=replace(CONFIG.init, sh_degree=degree))
    config = replace(config, optim=replace(config.optim, sh_degree_every=1000, sh_rest_lr=2.5e-3))
    gaussians = trained(scene, config, device)
    middle = np.mean([view.camera.position for view in scene.train], axis=0)
    return color_range(gaussians, middle / np.linalg.norm(middle)), held_out(gaussians, scene, config, device)


def _extrapolation(device: Device, data: Path | None) -> Found:
    few = TrainConfig().few.sh_degree
    figures, scores = [], []
    for degree in (3, few, 0):
        spread, psnr = unseen_colors(degree, device)
        figures.append(Figure(f"degree {degree}", spread))
        scores.append(Figure(f"degree {degree}, PSNR of the unseen side", psnr, "dB"))
    return Found([*figures, *scores])


def effective_ranks(gaussians: Gaussians) -> np.ndarray:
    """(N,) exp of the entropy of the squared scales' shares."""
    squares = gaussians.scales.astype(np.float64) ** 2
    shares = squares / squares.sum(axis=1, keepdims=True)
    return np.asarray(np.exp(-(shares * np.log(np.maximum(shares, 1e-300))).sum(axis=1)))


def needles(penalty: float, device: Device) -> tuple[float, float]:
    """Share of needles after a training with the regulariser's weight, %, and PSNR of held-out photos, dB."""
    scene = small_scene(device)
    config = replace(CONFIG, optim=replace(CONFIG.optim, erank_penalty=penalty, log_scales_lr=2e-2))
    gaussians = trained(scene, config, device)
    share = 100 * float((effective_ranks(gaussians) < NEEDLE).mean())
    return share, held_out(gaussians, scene, config, device)


def _effective_rank(device: Device, data: Path | None) -> Found:
    (plain, psnr_plain), (regular, psnr_regular) = (needles(p, device) for p in (0.0, ERANK_PENALTY))
    return Found(
        [
            Figure("no regulariser", plain, "%"),
            Figure(f"--optim.erank-penalty {ERANK_PENALTY}", regular, "%"),
            Figure("no regulariser, held-out photos", psnr_plain, "dB"),
            Figure("with it, held-out photos", psnr_regular, "dB"),
        ]
    )


EXTRAPOLATION = Experiment(
    failure="SH extrapolation",
    source="bands that no photo constrains",
    remedy="fewer bands where photos are few (`--few.sh-degree`); no gradient where a colour is clamped",
    test="tests/stability/test_views.py::test_unseen_sides_keep_their_colour",
    measure=_extrapolation,
    figure="largest difference of colours from SH0 in unseen directions, 95th percentile; 4 photos of a quarter of a "
    "circle whose brightness differs by 20 %",
)

EFFECTIVE_RANK = Experiment(
    failure="needles",
    source="Hyung et al. 2024, effective rank",
    remedy="a regulariser of the effective rank (`--optim.erank-penalty`)",
    test="tests/stability/test_views.py::test_the_regulariser_leaves_fewer_needles",
    measure=_effective_rank,
    figure=f"Gaussians of an effective rank below {NEEDLE}; 40 balls, 40x32, 300 iterations",
)
