"""Adaptation of a configuration to few photos, which many arrangements of Gaussians fit equally well, and to poses
that are refined.

With few photos none is held back to choose the number of Gaussians by: each shows what no other does, and two or
three do not decide. Splats are left out at random, so that none is indispensable, which generalises better to other
viewpoints (Park et al. 2025, "DropGaussian").
"""

from dataclasses import replace

from clsplat.config import TrainConfig
from clsplat.scene import Scene
from clsplat.training.autosize.rule import PER_PIXEL, cheapness, full_size, reach
from clsplat.training.autosize.validation import FEWEST_PHOTOS
from clsplat.training.densify.strategy import MOST_GAUSSIANS
from clsplat.training.run_length import SMALL_PHOTO, largest_photo
from clsplat.training.state import start_config

FEWEST_SEARCHED = 24
"""Fewest training photos with which the number of Gaussians is searched. Of fewer, three at most would be held back;
training without these costs more than the search gains (measured: docs/experiments/size.md)."""

SOME_DROPOUT = 1 / 2
"""Factor on `FewViewsConfig.dropout` with `FewViewsConfig.below` photos or more, but fewer than `FEWEST_SEARCHED`
(measured: docs/experiments/strategies.md)."""


def _fewest(config: TrainConfig, scene: Scene) -> bool:
    return len(scene.train) < config.few.below


def has_few(config: TrainConfig, scene: Scene) -> bool:
    """Whether a scene has too few training photos to search the number of Gaussians."""
    return len(scene.train) < (FEWEST_SEARCHED if config.few.below else FEWEST_PHOTOS)


def adapted(config: TrainConfig, scene: Scene) -> TrainConfig:
    """Adapt a configuration to the number of training photos.

    With fewer than `FEWEST_SEARCHED` the number of Gaussians is not searched, but grows as far as a search would let
    it, and dropout is on. If `config.few.below` is 0, this holds with fewer than `FEWEST_PHOTOS`, and without
    dropout. With fewer than `config.few.below` photos there is more dropout, and the number is bounded by a multiple
    of the points; for small photos by half of it, or one per pixel, and for large ones by what a search may reach if
    this is more (measured: docs/experiments/strategies.md). A fixed number that the configuration names is kept.

    If poses are refined, the number is not searched either, and grows as far: the poses of photos that do not train
    would be wrong, and would decide. Otherwise the configuration is returned as it is.
    """
    fewest = _fewest(config, scene)
    unsearched = config.size == "auto" and (fewest or has_few(config, scene) or config.poses)
    if not fewest and not unsearched:
        return config
    dropout = max(config.dropout, _dropout(config, scene))
    named = config.size == "fixed" and config.max_gaussians is not None
    init, points = config.init, len(scene.points)
    if unsearched:
        if not points:
            init = replace(init, random_points=start_config(config).random_points)
            points = init.random_points or 0
        config = replace(config, size="fixed")
    cap = config.max_gaussians
    if points and not named:
        growth = config.few.growth
        wanted = _most_of_few(growth * points, scene, config) if fewest else full_size(scene, points, config)
        most = max(1, min(round(wanted), MOST_GAUSSIANS))
        cap = most if cap is None else min(cap, most)
    return replace(config, init=init, max_gaussians=cap, dropout=dropout)


def _dropout(config: TrainConfig, scene: Scene) -> float:
    """Dropout at the end of a training, by the number of photos."""
    if _fewest(config, scene):
        return config.few.dropout
    return SOME_DROPOUT * config.few.dropout if config.few.below and has_few(config, scene) else 0.0


def _most_of_few(grown: float, scene: Scene, config: TrainConfig) -> float:
    """Largest number of Gaussians for the fewest photos, from a multiple of the points."""
    pixels = largest_photo(scene)
    most = min(grown, max(grown / 2, PER_PIXEL * pixels)) * cheapness(config)
    return max(most, reach(scene, config)) if pixels > SMALL_PHOTO else most
