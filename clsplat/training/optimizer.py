"""The optimiser's state and the schedules of the learning rates and of the spherical harmonics."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import OptimConfig
from clsplat.gaussians import Gaussians
from clsplat.stages import AdamStep

Array = NDArray[Any]


@dataclass
class Moments:
    """Adam's running means of the gradients and of their squares, row by row those of the Gaussians."""

    first: Gaussians
    second: Gaussians

    @classmethod
    def zeros(cls, gaussians: Gaussians) -> "Moments":
        """Moments at the start of the optimisation of `gaussians`."""
        first, second = (Gaussians(**{k: np.zeros_like(a) for k, a in gaussians.arrays().items()}) for _ in range(2))
        return cls(first, second)

    def take(self, rows: Array, fresh: Array) -> "Moments":
        """Moments after an edit of the rows: row i continues row rows[i], or starts at 0 where fresh[i]."""
        moved = Moments(self.first.take(rows), self.second.take(rows))
        for array in (*moved.first.arrays().values(), *moved.second.arrays().values()):
            array[fresh] = 0
        return moved


def sh_degree_at(iteration: int, every: int, stored: int) -> int:
    """Degree of the spherical harmonics that is rendered and trained in an iteration, counted from 1: one more after
    `every` iterations, up to the degree that is stored."""
    return min(stored, (iteration - 1) // every)


def adam_settings(iteration: int, progress: float, extent: float, config: OptimConfig, sh_degree: int) -> AdamStep:
    """Learning rates and constants of an iteration.

    Parameters
    ----------
    iteration : int
        Counted from 1.
    progress : float
        From 0 to 1, where means_lr_final is reached.
    extent : float
        Scale of the scene in world units: the means' rate is proportional to it.
    sh_degree : int
        Highest degree of the spherical harmonics that is trained.
    """
    rates = {
        "means": extent * config.means_lr * (config.means_lr_final / config.means_lr) ** progress,
        "log_scales": config.log_scales_lr,
        "quats": config.quats_lr,
        "logit_opacities": config.logit_opacities_lr,
        "sh0": config.sh0_lr,
        "sh_rest": config.sh_rest_lr,
    }
    return AdamStep(iteration, rates, config.beta1, config.beta2, config.eps, sh_degree)
