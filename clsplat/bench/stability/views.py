"""Experiments on what no photo shows: colours from other directions, needles that only a few photos hide."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.small import CONFIG, small_scene, with_train
from clsplat.bench.stability.trained import held_out, load, trained
from clsplat.config import TrainConfig
from clsplat.constants import NEAR
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.scene import Scene, View

Degree = Literal[0, 1, 2, 3]

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


def unseen_side(degree: Degree, device: Device) -> float:
    """PSNR of photos of the unseen side after a training of so many bands, dB."""
    scene = one_side(small_scene(device))
    config = replace(CONFIG, init=replace(CONFIG.init, sh_degree=degree))
    # A short training: bands come in it, and learn as fast as SH0.
    config = replace(config, optim=replace(config.optim, sh_degree_every=1000, sh_rest_lr=config.optim.sh0_lr))
    return held_out(trained(scene, config, device), scene, config, device)


def _extrapolation(device: Device, data: Path | None) -> Found:
    degrees: dict[Degree, str] = {3: "degree 3", 1: "--few.sh-degree 1", 0: "--few.sh-degree 0"}
    return Found([Figure(label, unseen_side(degree, device), "dB") for degree, label in degrees.items()])


def effective_ranks(gaussians: Gaussians) -> np.ndarray:
    """(N,) exp of the entropy of the squared scales' shares."""
    squares = gaussians.scales.astype(np.float64) ** 2
    shares = squares / squares.sum(axis=1, keepdims=True)
    return np.asarray(np.exp(-(shares * np.log(np.maximum(shares, 1e-300))).sum(axis=1)))


def _effective_rank(device: Device, data: Path | None) -> Found:
    scene, config = load(data, "castle_p30")
    shares, scores = [], []
    for label, penalty in (("no regulariser", 0.0), (f"--optim.erank-penalty {ERANK_PENALTY}", ERANK_PENALTY)):
        asked = replace(config, optim=replace(config.optim, erank_penalty=penalty))
        gaussians = trained(scene, asked, device)
        shares.append(Figure(label, 100 * float((effective_ranks(gaussians) < NEEDLE).mean()), "%"))
        scores.append(Figure(f"{label}, held-out photos", held_out(gaussians, scene, asked, device), "dB"))
    return Found([*shares, *scores])


def worst_view(gaussians: Gaussians, scene: Scene, config: TrainConfig, near: float | None, device: Device) -> float:
    """PSNR of the worst held-out photo where nothing nearer is drawn, dB."""
    asked = replace(config, render=replace(config.render, near=near))
    return min(held_out(gaussians, replace(scene, test=[view]), asked, device) for view in scene.test)


def _floaters(device: Device, data: Path | None) -> Found:
    scene, config = load(data, "castle_p30")
    config = replace(config, strategy="error", max_gaussians=6000, iterations=600)
    figures = []
    for label, trains, draws in (
        (f"--near {NEAR}", NEAR, NEAR),
        (f"trained with --near {NEAR}, drawn by itself", NEAR, None),
        ("trained and drawn by itself", None, None),
    ):
        asked = replace(config, render=replace(config.render, near=trains))
        figures.append(Figure(label, worst_view(trained(scene, asked, device), scene, config, draws, device), "dB"))
    return Found(figures)


FLOATERS = Experiment(
    failure="floaters near cameras",
    source="a Gaussian that a camera nearly touches spreads over its whole image",
    remedy="a near plane at a tenth of the depth of a dataset's nearest points",
    test="tests/stability/test_views.py::test_what_a_camera_nearly_touches_stays_out_of_the_image",
    measure=_floaters,
    figure="PSNR of the worst held-out photo of castle_p30, 96x64, 600 iterations of `error` with 6000",
    needs_data=True,
)

EXTRAPOLATION = Experiment(
    failure="SH extrapolation",
    source="bands that no photo constrains",
    remedy="fewer bands, by themselves where photos are few (`--few.sh-degree`)",
    test="tests/stability/test_views.py::test_unseen_sides_keep_their_colour",
    measure=_extrapolation,
    figure="PSNR of photos from the other side; trained on 4 of a quarter of a circle whose brightness differs by "
    "20 %, 40x32, bands that learn as fast as SH0",
)

EFFECTIVE_RANK = Experiment(
    failure="needles",
    source="Hyung et al. 2024, effective rank",
    remedy="a regulariser of the effective rank (`--optim.erank-penalty`)",
    test="tests/stability/test_views.py::test_the_regulariser_leaves_fewer_needles",
    measure=_effective_rank,
    figure=f"Gaussians of an effective rank below {NEEDLE}; castle_p30, 96x64, 500 iterations",
    needs_data=True,
)
