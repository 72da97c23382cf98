"""Schedule of strategies that grow to a cap: iterations of the rounds, and the number of Gaussians after each."""

from math import ceil, sqrt
from typing import Protocol

from clsplat.config import TrainConfig
from clsplat.errors import InputError

TRIAL_LENGTH = 0.05
"""Fraction of the iterations that a trial of pruning of `clsplat.training.autosize`, and a window of growth, take
(measured: docs/size.md)."""

GROWTH_SHORTEST = 100
"""Fewest iterations of a window of growth: the interval between two rounds of the strategies."""

TRIAL_GROWTH = sqrt(2)
"""Factor by which the number of Gaussians grows in a window, unless `MOST_GROWTH` limits its rounds to less."""

MOST_GROWTH = 1.25
"""Largest factor by which the number of Gaussians grows in a round (measured: docs/size.md). A factor of 2 would
split every Gaussian, wherever it is."""


def growth_window(config: TrainConfig) -> int:
    """Iterations in which the number of Gaussians grows by `TRIAL_GROWTH`."""
    return max(round(TRIAL_LENGTH * config.iterations), GROWTH_SHORTEST)


class Growth(Protocol):
    """Settings of a schedule, such as `clsplat.config.McmcConfig`."""

    @property
    def start(self) -> int: ...
    @property
    def stop_fraction(self) -> float: ...
    @property
    def every(self) -> int: ...
    @property
    def growth(self) -> float: ...
    @property
    def full_fraction(self) -> float: ...


class Schedule:
    """Rounds at equal intervals, and growth by equal factors: to the cap, or by `TRIAL_GROWTH` in a window with
    ``--size auto``.

    Raises
    ------
    InputError
        If there is no cap to grow to.
    """

    def __init__(self, config: TrainConfig, settings: Growth) -> None:
        if config.max_gaussians is None and config.size == "fixed":
            raise InputError(
                f"--max-gaussians: expected with --strategy {config.strategy}, which grows to that number, found "
                "none; --size auto finds one"
            )
        self.every, self.growth = settings.every, settings.growth
        self.start = config.shortened(settings.start)
        self.full = round(settings.full_fraction * config.iterations)
        self.stop = round(settings.stop_fraction * config.iterations)
        steady = TRIAL_GROWTH ** (self.every / growth_window(config))
        self.factor = min(MOST_GROWTH, steady) if config.size == "auto" else 0

    def due(self, iteration: int) -> bool:
        """Whether a round is due after an iteration, counted from 1."""
        return self.start <= iteration < self.stop and iteration % self.every == 0

    def count_after(self, iteration: int, n: int, cap: int) -> int:
        """Number of Gaussians after a round that began with n.

        It grows by a fixed fraction, and by at least the equal factor that reaches the cap in the remaining rounds of
        the growth phase. It never falls.
        """
        if n >= cap:
            return n
        if self.factor:
            return min(cap, ceil(n * self.factor))
        rounds = max(1, self.full // self.every - iteration // self.every + 1)
        return min(cap, round(n * max(1 + self.growth, (cap / n) ** (1 / rounds))))
