"""Length of a training by the number of its photos."""

from dataclasses import replace

from clsplat.config import TrainConfig
from clsplat.scene import Scene

VISITS = 30
"""Iterations for each training photo (measured: docs/benchmarks.md)."""

FEWEST_ITERATIONS = 3000
"""Fewest iterations: few photos, too, need time for growth."""

MOST_ITERATIONS = 30_000
"""Most iterations, those of the paper's longer setting."""


def with_iterations(config: TrainConfig, scene: Scene) -> TrainConfig:
    """Choose the number of iterations by the number of training photos, if the configuration leaves it open."""
    if config.iterations:
        return config
    wanted = VISITS * len(scene.train)
    return replace(config, iterations=min(MOST_ITERATIONS, max(FEWEST_ITERATIONS, wanted)))
