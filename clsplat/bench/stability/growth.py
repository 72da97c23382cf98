"""Experiments on densification: resets of opacities, and photos of noise that make the number of Gaussians grow."""

from dataclasses import replace
from tempfile import TemporaryDirectory

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found, Plot
from clsplat.bench.stability.small import CONFIG, small_scene, with_train
from clsplat.config import AdcConfig, TrainConfig
from clsplat.device import Device
from clsplat.evaluate import mean_metrics
from clsplat.renderer import Renderer
from clsplat.scene import Scene, View
from clsplat.training.loop import train

RESET_CONFIG = replace(
    CONFIG, iterations=400, adc=replace(CONFIG.adc, every=25, reset_every=150, start=50, stop_fraction=0.8)
)
AFTER = (-1, 0, 5, 10, 20, 40)
"""Iterations, counted from a reset, after which held-out photos are evaluated. Rounds of densification lie between 0
and 40."""

CAP = 300
"""Maximal number of Gaussians in the experiment on photos of noise."""


def around_reset(adc: AdcConfig, scene: Scene, device: Device) -> tuple[list[float], float]:
    """PSNR of held-out photos at the iterations `AFTER` the second reset, and at the end, dB."""
    config, found = replace(RESET_CONFIG, adc=adc), []

    def evaluate(gaussians: object) -> dict[str, float]:
        found.append(mean_metrics(gaussians, scene.test, Renderer(device, config.render))["psnr"])  # type: ignore[arg-type]
        return {}

    marks = [2 * RESET_CONFIG.adc.reset_every + after for after in AFTER]
    with TemporaryDirectory() as out:
        train(scene, config, out, device, evaluate=evaluate, evaluate_after=[*marks, config.iterations])
    return found[:-1], found[-1]


def _reset(device: Device) -> Found:
    scene, adc = small_scene(device), RESET_CONFIG.adc
    variants = {
        "reset": adc,
        "--adc.opacity-decay 0.05": replace(adc, opacity_decay=0.05),
        "--adc.opacity-decay 0.5": replace(adc, opacity_decay=0.5),
    }
    figures, ends, series = [], [], {}
    for label, settings in variants.items():
        curve, end = around_reset(settings, scene, device)
        figures.append(Figure(f"{label}, dip", curve[0] - min(curve), "dB"))
        ends.append(Figure(f"{label}, at the end", end, "dB"))
        points: list[tuple[float, float | None]] = [(float(x), y) for x, y in zip(AFTER, curve, strict=True)]
        series[label] = points
    return Found([*figures, *ends], Plot("iterations after the reset", "PSNR of held-out photos, dB", series))


def noise(view: View, rng: np.random.Generator) -> View:
    """Replace a photo by random colours per pixel."""
    return replace(view, image=rng.integers(0, 256, view.image.shape, dtype=np.uint8))


def checkerboard(view: View, rng: np.random.Generator) -> View:
    """Replace a photo by black and white squares of 2 px, shifted at random."""
    y, x = np.indices(view.image.shape[:2]) + rng.integers(0, 4, 2)[:, None, None]
    white = (x // 2 + y // 2) % 2 == 0
    return replace(view, image=np.where(white[:, :, None], np.uint8(255), np.uint8(0)).repeat(3, axis=2))


def largest_number(scene: Scene, config: TrainConfig, device: Device) -> int:
    """Largest number of Gaussians in any iteration of a training."""
    most = 0

    def watch(record: dict[str, object]) -> None:
        nonlocal most
        most = max(most, int(record["num_gaussians"]))  # type: ignore[call-overload]

    with TemporaryDirectory() as out:
        train(scene, config, out, device, progress=watch)
    return most


def _blow_up(device: Device) -> Found:
    scene, figures = small_scene(device), []
    config = replace(CONFIG, iterations=400, adc=replace(CONFIG.adc, every=25))
    for label, photos in {
        "scene": scene,
        "noise": with_train(scene, noise),
        "checkerboard": with_train(scene, checkerboard),
    }.items():
        for cap in (None, CAP):
            asked = replace(config, max_gaussians=cap)
            figures.append(
                Figure(f"{label}, {f'cap {cap}' if cap else 'no cap'}", largest_number(photos, asked, device))
            )
    # First without the remedy: noise without a cap.
    return Found([figures[2], *figures[:2], *figures[3:]])


OPACITY_RESET = Experiment(
    failure="opacity reset",
    source="gsplat #1011, #1012: dips of 2.7 to 7.6 dB",
    remedy="instead, each round reduces opacities by a fraction (`--adc.opacity-decay`)",
    test="tests/stability/test_growth.py::test_opacities_that_decay_make_no_dip",
    measure=_reset,
    figure="PSNR of held-out photos before a reset minus the lowest within 40 iterations after it; 40 balls, 40x32",
)

BLOW_UP = Experiment(
    failure="densification blow-up",
    source="poison-splat, Lu et al. 2024: 1.7 to 4 times the Gaussians",
    remedy="a hard cap, largest gradients first (`--max-gaussians`); a prediction of the memory (`--memory-limit`)",
    test="tests/stability/test_growth.py::test_photos_of_noise_stay_under_the_cap",
    measure=_blow_up,
    figure="largest number of Gaussians in 400 iterations, from 40 points",
)
