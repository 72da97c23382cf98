"""Real scenes for the experiments of this folder.

The photos are small and the trainings short, so that an experiment takes minutes on two cores.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.config import DataConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.scene import Scene

SHORT = TrainConfig(strategy="adc", size="fixed", iterations=500, eval_every=0, data=DataConfig(downscale=8))
"""Configuration of a short training. At this scale fern is 120x90, fox_pinhole 67x120 and castle_p30 96x64."""


def load(data: Path, name: str, config: TrainConfig = SHORT) -> tuple[Scene, TrainConfig]:
    """Load the scene `name` of the folder `data`, and return it with the configuration of its training."""
    return load_scene(data / name, config.data), config


def spread(scene: Scene, count: int) -> Scene:
    """Keep `count` training photos, evenly spread by name, and the points that at least two of them show."""
    rows = np.rint(np.linspace(0, len(scene.train) - 1, count)).astype(int)
    train = [scene.train[i] for i in rows]
    shown = np.zeros(len(scene.points), int)
    for camera in [view.camera for view in train]:
        p = scene.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        x, y = camera.fx * p[:, 0] + camera.cx * p[:, 2], camera.fy * p[:, 1] + camera.cy * p[:, 2]
        shown += (p[:, 2] > 0) & (0 <= x) & (x < camera.width * p[:, 2]) & (0 <= y) & (y < camera.height * p[:, 2])
    return replace(scene, train=train, points=scene.points[shown >= 2], colors=scene.colors[shown >= 2])
