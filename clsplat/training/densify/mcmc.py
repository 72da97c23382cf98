"""3D Gaussian Splatting as Markov chain Monte Carlo: relocation, growth to a cap, noise (Kheradmand et al. 2024)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import TrainConfig
from clsplat.gaussians import Gaussians, logit
from clsplat.randomness import stream
from clsplat.stages import Stages
from clsplat.training.densify.schedule import Schedule
from clsplat.training.densify.strategy import Edit, Strategy, Survey
from clsplat.training.run_length import FEWEST_ITERATIONS

Array = NDArray[Any]

COPIES_MAX = 51
"""Largest number of copies of a Gaussian made in one round; binomial coefficients up to it are exact in float64
(original)."""


class Mcmc(Strategy):
    """Gaussians as samples: dead ones move to live ones, noise explores, penalties make unneeded ones transparent.

    It keeps no statistics.
    """

    start_opacity = 0.5  # original

    def __init__(self, config: TrainConfig, extent: float, n: int) -> None:
        super().__init__(config, extent, n)
        self.config, self.seed, self.extent = config.mcmc, config.seed, extent
        every = interval(config)
        self.schedule = Schedule(config, config.mcmc, every, every)

    def penalties(self, n: int) -> tuple[float, float]:
        """See `clsplat.training.densify.Strategy`; the configured weights are those of means over Gaussians and
        axes."""
        return self.config.opacity_penalty / n, self.config.scale_penalty / (3 * n * self.extent)

    def perturb(self, stages: Stages, gaussians: Gaussians, iteration: int, rate: float) -> None:
        """See `clsplat.training.densify.Strategy`."""
        if self.config.noise_lr > 0:
            stages.add_noise(gaussians, self.config.noise_lr * rate / self.extent**2, self.seed, iteration)

    def due(self, iteration: int) -> bool:
        """See `clsplat.training.densify.Strategy`."""
        return self.schedule.due(iteration)

    def edit(self, iteration: int, gaussians: Gaussians, cap: int, survey: Survey) -> Edit:
        """See `clsplat.training.densify.Strategy`."""
        n = len(gaussians)
        rows, fresh = np.arange(n), np.zeros(n, bool)
        dead = gaussians.opacities <= self.config.opacity_min
        alive = np.flatnonzero(~dead)
        if len(alive) == 0:
            return Edit(gaussians, rows, fresh)
        draw = stream(self.seed, "sources of relocated Gaussians", iteration)
        sources = alive[sample(gaussians.opacities[alive], int(dead.sum()), draw)]
        rows[dead] = sources
        fresh |= dead
        fresh[sources] = True
        moved = gaussians.take(rows)
        share(moved, np.bincount(rows, minlength=n)[rows], self.config.opacity_min)

        draw = stream(self.seed, "sources of new Gaussians", iteration)
        added = sample(moved.opacities, self.schedule.count_after(iteration, n, cap) - n, draw)
        fresh[added] = True
        all_rows = np.concatenate([np.arange(n), added])
        grown = moved.take(all_rows)
        share(grown, np.bincount(all_rows, minlength=n)[all_rows], self.config.opacity_min)
        return Edit(grown, rows[all_rows], np.concatenate([fresh, np.ones(len(added), bool)]))


def interval(config: TrainConfig) -> int:
    """Iterations between two rounds: with ``--size auto`` a short run has as many as one of `FEWEST_ITERATIONS`."""
    share = min(1.0, config.iterations / FEWEST_ITERATIONS) if config.size == "auto" else 1.0
    return max(1, round(config.mcmc.every * share))


def sample(weights: Array, count: int, generator: np.random.Generator) -> Array:
    """Draw rows (count,) with replacement, with probabilities in proportion to their weights."""
    sums = np.cumsum(weights, dtype=np.float64)
    rows = np.searchsorted(sums, generator.random(count) * sums[-1], side="right")
    return np.minimum(rows, len(weights) - 1)


def share(gaussians: Gaussians, copies: Array, opacity_min: float) -> None:
    """Change opacities and scales of Gaussians of which there are `copies` (N,) in one place (equation 9), in place.

    Together the copies have the opacity of the original at the centre, and the same integral of opacity along every
    line through it.
    """
    shared = np.flatnonzero(copies > 1)
    count = np.minimum(copies[shared], COPIES_MAX)
    opacities = gaussians.opacities[shared].astype(np.float64)
    parts = -np.expm1(np.log1p(-np.minimum(opacities, 1 - 1e-7)) / count)
    parts = np.maximum(parts, opacity_min)
    gaussians.logit_opacities[shared] = logit(parts)
    gaussians.log_scales[shared] += np.log(opacities / integral(parts, count))[:, None]


def integral(opacities: Array, copies: Array) -> Array:
    """Integral along a line of the opacity of coincident Gaussians, in units of sqrt(2 pi) scales.

    1 - (1 - o g)^N with g = exp(-x^2/2) is the sum over k of C(N, k + 1) (-1)^k (o g)^(k + 1), term by term an
    integral of a Gaussian.
    """
    total, term = np.zeros(len(opacities)), copies * opacities
    for k in range(COPIES_MAX):
        total += term / np.sqrt(k + 1)
        term = -term * opacities * (copies - k - 1) / (k + 2)
    return total
