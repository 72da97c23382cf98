"""Trainings for experiments on real scenes: short, on small photos, so that a row takes minutes on two cores."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from clsplat.config import BACKGROUNDS, DataConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluate import Metric, mean_metrics
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr
from clsplat.scene import Scene

SHORT = TrainConfig(strategy="adc", size="fixed", iterations=500, eval_every=0, data=DataConfig(downscale=8))
"""Of fern at 120x90, fox_pinhole at 67x120, castle_p30 at 96x64."""


def load(data: Path | None, name: str, config: TrainConfig = SHORT) -> tuple[Scene, TrainConfig]:
    """A real scene and the configuration it is trained with."""
    if data is None:
        raise InputError("data: expected the folder of real scenes, found none")
    return load_scene(data / name, config.data), config


def trained(scene: Scene, config: TrainConfig, device: Device) -> Gaussians:
    """The Gaussians of a training whose files are not kept."""
    from clsplat.training.loop import train

    with TemporaryDirectory() as out:
        return train(scene, config, device, Path(out))


def held_out(gaussians: Gaussians, scene: Scene, config: TrainConfig, device: Device, metric: Metric = psnr) -> float:
    """Mean PSNR of the held-out photos, or what `metric` says, dB."""
    background = BACKGROUNDS[config.data.background]
    return mean_metrics(gaussians, scene.test, config.render, device, background, (metric,))[metric.__name__]


def spread(scene: Scene, count: int) -> Scene:
    """The scene with so many of its training photos, evenly spread by name, and the points that two of them show."""
    rows = np.rint(np.linspace(0, len(scene.train) - 1, count)).astype(int)
    train = [scene.train[i] for i in rows]
    shown = np.zeros(len(scene.points), int)
    for camera in [view.camera for view in train]:
        p = scene.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        x, y = camera.fx * p[:, 0] + camera.cx * p[:, 2], camera.fy * p[:, 1] + camera.cy * p[:, 2]
        shown += (p[:, 2] > 0) & (0 <= x) & (x < camera.width * p[:, 2]) & (0 <= y) & (y < camera.height * p[:, 2])
    return replace(scene, train=train, points=scene.points[shown >= 2], colors=scene.colors[shown >= 2])
