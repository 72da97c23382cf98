"""Experiment: a training that starts from random points."""

from dataclasses import replace
from pathlib import Path

from real_scenes import SHORT, load

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.trained import held_out, trained
from clsplat.config import DataConfig, TrainConfig
from clsplat.dataset import with_points
from clsplat.device import Device
from clsplat.scene import Scene

CAP = 6000
"""Maximal number of Gaussians of the short trainings."""

LONGER = replace(SHORT, strategy="error", size="auto", iterations=2000, data=DataConfig(downscale=4))
"""The default configuration with a fifteenth of the paper's iterations, at a quarter of the photos' size."""


def points_lost(
    data: Path, name: str, config: TrainConfig, device: Device, boxes: tuple[int, ...] = (1,)
) -> dict[str, float]:
    """Measure the PSNR that held-out photos lose when training starts without the points of structure from motion.

    Parameters
    ----------
    data : Path
        Folder that holds the scene `name`.
    name : str
    config : TrainConfig
    device : Device
    boxes : tuple of int
        Edge lengths of the boxes of random points, in multiples of the edge length that `config` sets.

    Returns
    -------
    dict
        Lost PSNR, dB, per start. ``triangulated``: points found from the photos and their poses. ``random``,
        ``random, box 3x`` and so on: random points.
    """
    scene, _ = load(data, name, config)
    none = replace(scene, points=scene.points[:0], colors=scene.colors[:0])

    def reached(start: Scene, config: TrainConfig) -> float:
        return held_out(trained(start, config, device), scene, config, device)

    best = reached(scene, config)
    lost = {}
    for box in boxes:
        wide = replace(config, init=replace(config.init, random_extent=box * config.init.random_extent))
        lost["random" if box == 1 else f"random, box {box}x"] = best - reached(none, wide)
    return lost | {"triangulated": best - reached(with_points(none, data / name, config.data), config)}


def _random_start(device: Device, data: Path) -> Found:
    figures = []
    for name in ("fox_pinhole", "fern"):
        for start, lost in points_lost(data, name, LONGER, device).items():
            figures.append(Figure(f"{name}, {start}", lost, "dB"))
    for strategy in ("adc", "mcmc", "error"):
        config = replace(SHORT, strategy=strategy, max_gaussians=CAP)
        config = replace(config, init=replace(config.init, random_points=CAP // 2))
        for start, lost in points_lost(data, "fox_pinhole", config, device, boxes=(1, 3)).items():
            figures.append(Figure(f"{strategy}, {start}", lost, "dB"))
    return Found(figures)


RANDOM_START = Experiment(
    failure="no points (random start)",
    source="Kheradmand et al. 2024: 3DGS loses 5 dB, MCMC 0.1 dB",
    remedy="points triangulated from the photos and their poses (`--init.triangulate`)",
    test="tests/stability/test_growth.py::test_points_found_by_the_poses_are_as_good_as_given_ones",
    measure=_random_start,
    figure="PSNR that held-out photos lose without the scene's own points; "
    f"{LONGER.iterations} iterations, `--size auto`, 134x240 and 240x180; "
    f"by strategy: fox_pinhole at 67x120, {SHORT.iterations} iterations, at most {CAP} Gaussians",
)
