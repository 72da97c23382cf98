"""When a strategy that grows to a cap has its rounds, and how many Gaussians there are after each."""

from math import ceil, sqrt

from clsplat.config import ErrorConfig, McmcConfig, TrainConfig
from clsplat.errors import InputError

TRIAL_LENGTH = 0.05
"""Fraction of the iterations that a trial of pruning of `clsplat.training.autosize`, and a window of growth, take
(measured: docs/size.md)."""

GROWTH_SHORTEST = 100
"""Iterations of a window of growth at least: the strategies' rounds are so far apart."""

TRIAL_GROWTH = sqrt(2)
"""Factor by which the Gaussians grow in a window of growth, if that has rounds enough for `MOST_GROWTH`."""

MOST_GROWTH = 1.25
"""Factor by which they grow in a round at most. Twice as many in one round are a split of each, wherever it is: 1.41
ended 0.4 dB, 2 ended 0.8 dB below a growth to the same number by parts (fox_pinhole, 135x240, 2000 iterations)."""


def growth_window(config: TrainConfig) -> int:
    """Iterations in which the Gaussians grow by `TRIAL_GROWTH`."""
    return max(round(TRIAL_LENGTH * config.iterations), GROWTH_SHORTEST)


class Schedule:
    """Rounds every so many iterations, and growth by equal factors: to the cap, or, with ``--size auto``, by
    `TRIAL_GROWTH` in a window.

    Raises
    ------
    InputError
        If there is no cap to grow to.
    """

    def __init__(self, config: TrainConfig, settings: McmcConfig | ErrorConfig) -> None:
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

    def size_after(self, iteration: int, n: int, cap: int) -> int:
        """Gaussians after a round that began with n: a fixed fraction more, and no less than takes them to the cap by
        equal factors in the rounds until it is to be full; none are taken away."""
        if n >= cap:
            return n
        if self.factor:
            return min(cap, ceil(n * self.factor))
        rounds = max(1, self.full // self.every - iteration // self.every + 1)
        return min(cap, round(n * max(1 + self.growth, (cap / n) ** (1 / rounds))))
