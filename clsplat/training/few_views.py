"""Adaptation of a configuration to few photos, which many arrangements of Gaussians fit equally well.

With few photos none is held back to choose the number of Gaussians by: each shows what no other does, and two or
three do not decide. Splats are left out at random, so that none is indispensable, which generalises better to other
viewpoints (Park et al. 2025, "DropGaussian").
"""

from dataclasses import replace

from clsplat.config import TrainConfig
from clsplat.scene import Scene
from clsplat.training.autosize.rule import PER_PIXEL, RANDOM_START, reach
from clsplat.training.densify.strategy import MOST_GAUSSIANS
from clsplat.training.run_length import SMALL_PHOTO, largest_photo


def adapted(config: TrainConfig, scene: Scene) -> TrainConfig:
    """Adapt a configuration to the number of training photos.

    With fewer than `config.few.below` dropout is on, and the number of Gaussians is not searched but bounded by a
    multiple of the points; for small photos by half of it, or one per pixel, and for large ones by what a search may
    reach if this is more (measured: docs/experiments/strategies.md). Otherwise the configuration is returned as it
    is.
    """
    few = config.few
    if len(scene.train) >= few.below:
        return config
    init, first = config.init, len(scene.points)
    if config.size == "auto":
        config = replace(config, size="fixed")
        if not first:
            first = init.random_points or RANDOM_START
            init = replace(init, random_points=first)
    cap = config.max_gaussians
    if first:
        pixels, grown = largest_photo(scene), few.growth * first
        most = min(grown, max(grown / 2, PER_PIXEL * pixels))
        if pixels > SMALL_PHOTO:
            most = max(most, reach(scene))
        most = max(1, min(round(most), MOST_GAUSSIANS))
        cap = most if cap is None else min(cap, most)
    return replace(config, init=init, max_gaussians=cap, dropout=max(config.dropout, few.dropout))
