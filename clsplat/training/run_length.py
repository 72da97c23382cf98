"""Length of a training, and size of its first photos, by the number and the size of the photos."""

from dataclasses import replace
from typing import Final, Literal

from clsplat.config import TrainConfig
from clsplat.scene import Scene

VISITS = 30
"""Iterations for each training photo (measured: docs/benchmarks.md)."""

FEWEST_ITERATIONS = 3000
"""Fewest iterations with photos of at most `SMALL_PHOTO` pixels: few photos, too, need time for growth."""

FEW_LENGTH = 1 / 2
"""Factor on the fewest iterations with fewer photos than `FewViewsConfig.below`. Each photo trains often enough, and
more iterations fit these photos only (measured: docs/experiments/schedules.md)."""

SMALL_PHOTO = 90_000
"""Pixels up to which photos count as small. With larger ones the fewest iterations, and the number of Gaussians that
growth may reach, are in proportion to the root of their edges (measured: docs/benchmarks.md)."""

MOST_ITERATIONS = 30_000
"""Most iterations, those of the paper's longer setting."""

FIRST_FACTOR: Final = 4
"""Divisor of the edges of larger photos at the start (measured: docs/experiments/schedules.md)."""


def largest_photo(scene: Scene) -> int:
    """Pixels of the largest training photo."""
    return max(view.camera.width * view.camera.height for view in scene.train)


def detail(scene: Scene) -> float:
    """Factor by which larger photos take more iterations and Gaussians than small ones: the root of their edges."""
    return max(1.0, largest_photo(scene) / SMALL_PHOTO) ** 0.25


def with_length(config: TrainConfig, scene: Scene) -> TrainConfig:
    """Choose what the configuration leaves to the training photos.

    Parameters
    ----------
    config : TrainConfig
    scene : Scene

    Returns
    -------
    TrainConfig
        With a number of iterations, and a divisor of the photos' edges at the start: 1 for small photos and where the
        size is fixed.
    """
    if not config.iterations:
        few = len(scene.train) < config.few.below
        fewest = FEWEST_ITERATIONS * detail(scene) * (FEW_LENGTH if few else 1)
        wanted = max(round(fewest), VISITS * len(scene.train))
        config = replace(config, iterations=min(MOST_ITERATIONS, wanted))
    if not config.coarse.factor:
        factor: Literal[1, 4] = FIRST_FACTOR if config.size == "auto" and detail(scene) > 1 else 1
        config = replace(config, coarse=replace(config.coarse, factor=factor))
    return config
