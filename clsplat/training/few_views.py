"""Adaptation of a configuration to few photos, which many arrangements of Gaussians fit equally well.

Without it, many Gaussians with view-dependent colours fit each photo separately. Fewer and simpler Gaussians, none of
which is indispensable, generalise better to other viewpoints (Park et al. 2025, "DropGaussian").
"""

from dataclasses import replace

from clsplat.config import TrainConfig
from clsplat.scene import Scene
from clsplat.training.autosize.rule import RANDOM_START
from clsplat.training.densify.strategy import MOST_GAUSSIANS

OPACITY = 0.1
"""Opacity of the first Gaussians, as the paper's, unless it is given (measured: docs/howto/strategies.md). With few
photos, what is hidden behind opaque Gaussians is not corrected by another photo."""


def adapted(config: TrainConfig, scene: Scene) -> TrainConfig:
    """Adapt a configuration to the number of training photos.

    With fewer than `config.few.below` the spherical harmonics have a lower degree, dropout is on, and there are fewer
    Gaussians, whose number is not searched. Otherwise the configuration is returned as it is.
    """
    few = config.few
    if len(scene.train) >= few.below:
        return config
    opacity = OPACITY if config.init.opacity is None else config.init.opacity
    init = replace(config.init, sh_degree=min(config.init.sh_degree, few.sh_degree), opacity=opacity)
    first = len(scene.points)
    if config.size == "auto":  # too few photos to validate
        config = replace(config, size="fixed")
        if not first:
            first = init.random_points or RANDOM_START
            init = replace(init, random_points=first)
    cap = config.max_gaussians
    if first:
        most = min(max(1, round(few.growth * first)), MOST_GAUSSIANS)
        cap = most if cap is None else min(cap, most)
    return replace(config, init=init, max_gaussians=cap, dropout=max(config.dropout, few.dropout))
