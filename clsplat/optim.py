"""Adam in NumPy and the schedules of the learning rates and of the spherical harmonics."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import OptimConfig
from clsplat.gaussians import SHAPES, Gaussians

Array = NDArray[Any]

# Values updated at once: their five arrays stay in a core's L2 cache.
BLOCK = 32768


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


def learning_rates(iteration: int, iterations: int, extent: float, config: OptimConfig) -> dict[str, float]:
    """Learning rate per parameter group in an iteration, counted from 1.

    Parameters
    ----------
    iteration, iterations : int
        The current one and the last one, at which means_lr_final is reached.
    extent : float
        Scale of the scene in world units: the means' rate is proportional to it.

    Returns
    -------
    dict
        By field of `Gaussians`, with sh0 and sh_rest in the place of sh.
    """
    progress = (iteration - 1) / max(iterations - 1, 1)
    return {
        "means": extent * config.means_lr * (config.means_lr_final / config.means_lr) ** progress,
        "log_scales": config.log_scales_lr,
        "quats": config.quats_lr,
        "logit_opacities": config.logit_opacities_lr,
        "sh0": config.sh0_lr,
        "sh_rest": config.sh_rest_lr,
    }


def adam_step(
    gaussians: Gaussians,
    gradients: Gaussians,
    moments: Moments,
    rates: dict[str, float],
    iteration: int,
    sh_degree: int,
    config: OptimConfig,
) -> None:
    """One step of Adam (Kingma and Ba 2015, algorithm 1), in place.

    Parameters
    ----------
    gaussians, gradients, moments
        Arrays of one dtype; gaussians and moments are updated.
    rates : dict
        As `learning_rates` returns them.
    iteration : int
        Counted from 1: the exponent of the bias corrections.
    sh_degree : int
        Bands above it have had no gradient yet; their update would be 0 and is left out.
    """
    correction1, correction2 = 1 - config.beta1**iteration, 1 - config.beta2**iteration
    for name in SHAPES:
        n = len(gaussians)
        width = 3 * (sh_degree + 1) ** 2 if name == "sh" else max(1, gaussians.arrays()[name][:1].size)
        if name == "sh":
            rate: Any = np.full(width, rates["sh_rest"], gaussians.sh.dtype)
            rate[:3] = rates["sh0"]
        else:
            rate = rates[name]
        p, g, m, v = (
            getattr(c, name).reshape(n, -1)[:, :width] for c in (gaussians, gradients, moments.first, moments.second)
        )
        rows = max(1, BLOCK // width)
        for begin in range(0, n, rows):
            block = slice(begin, begin + rows)
            _adam_block(p[block], g[block], m[block], v[block], rate / correction1, correction2, config)


def _adam_block(p: Array, g: Array, m: Array, v: Array, rate: Any, correction2: float, config: OptimConfig) -> None:
    m *= config.beta1
    m += (1 - config.beta1) * g
    v *= config.beta2
    v += (1 - config.beta2) * (g * g)
    denominator = np.sqrt(v * (1 / correction2))
    denominator += config.eps
    p -= rate * (m / denominator)
