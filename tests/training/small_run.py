"""A small training: photos of known Gaussians, and settings under which every strategy edits."""

from dataclasses import replace

import numpy as np
import pytest
from every_strategy import with_rounds

from clsplat.camera import Camera
from clsplat.config import AdcConfig, CoarseConfig, InitConfig, OptimConfig, TrainConfig
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene
from clsplat.training.densify import STRATEGIES

SIZE = (40, 32)
EACH_STRATEGY = pytest.mark.parametrize("strategy", STRATEGIES)
CONFIG = with_rounds(
    TrainConfig(
        strategy="adc",
        size="fixed",
        iterations=60,
        checkpoint_every=25,
        init=InitConfig(sh_degree=1, dense=False),  # the numbers of Gaussians are those of the points
        optim=OptimConfig(sh_degree_every=2333),
        coarse=CoarseConfig(factor=1),  # what `with_length` would choose: checkpoints have it
        # Small enough to see a clone, a split and a reset within 60 iterations.
        adc=AdcConfig(reset_every=30, grad_threshold=1e-5),
    ),
    every=10,
    stop_fraction=0.8,
)


def with_strategy(strategy: str) -> TrainConfig:
    """40 Gaussians at the start, and a cap that each strategy reaches."""
    return replace(CONFIG, strategy=strategy, max_gaussians=61)


def cameras(count: int) -> list[Camera]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        Camera.look_at([3 * np.sin(a), -1 + 0.3 * np.sin(3 * a), 3 * np.cos(a)], [0, 0, 0], [0, -1, 0], 45, *SIZE)
        for a in angles
    ]


def known_scene() -> Scene:
    """Photos of known Gaussians, rendered by the twins."""
    rng = np.random.default_rng(0)
    truth = synthetic_scene(40, seed=4)[0]
    truth.means[:] = rng.uniform(-0.6, 0.6, truth.means.shape)
    truth.log_scales[:] = np.log(0.15)
    truth.logit_opacities[:] = 1.5
    truth.sh[:, 0] = rng.uniform(-1, 1.5, (40, 3))
    views = [
        View(f"{i}.png", c, to_uint8(render(truth, c, device="reference").rgb)) for i, c in enumerate(cameras(13))
    ]
    points = truth.means + rng.normal(0, 0.05, truth.means.shape)
    return Scene(views[:12], views[12:], points.astype(np.float64), np.full(points.shape, 128, np.uint8))


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(x.tobytes() == y.tobytes() for x, y in zip(a.arrays().values(), b.arrays().values(), strict=True))
