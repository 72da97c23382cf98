"""What changes in a training on few photos, which many arrangements of Gaussians explain alike.

Left to themselves, Gaussians fit each photo by itself: ever more of them, with colours that depend on
direction. Fewer and simpler ones, of which no single one is needed, show more of the truth between the photos (Park
et al. 2025, "DropGaussian").
"""

from dataclasses import replace

from clsplat.config import TrainConfig
from clsplat.scene import Scene


def adapted(config: TrainConfig, scene: Scene) -> TrainConfig:
    """The configuration for the scene's training photos: where they are fewer than `config.few.below`, of a lower
    degree, with dropout, and with fewer Gaussians, whose number is not sought; otherwise as it is."""
    few = config.few
    if len(scene.train) >= few.below:
        return config
    cap = config.max_gaussians
    if len(scene.points):
        most = round(few.growth * len(scene.points))
        cap = most if cap is None else min(cap, most)
    init = replace(config.init, sh_degree=min(config.init.sh_degree, few.sh_degree))
    if config.size == "auto":  # too few photos to validate by; measured with the paper's strategy
        config = replace(config, size="fixed", strategy="adc")
    return replace(config, init=init, max_gaussians=cap, dropout=max(config.dropout, few.dropout))
