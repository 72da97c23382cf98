"""Schedule of strategies that grow to a cap: iterations of the rounds, and the number of Gaussians after each."""

from math import ceil
from typing import Protocol

from clsplat.config import TrainConfig
from clsplat.errors import InputError
from clsplat.training.run_length import FEWEST_ITERATIONS

WINDOW = 0.1
"""Fraction of the iterations after which ``--size auto`` raises the cap."""

GROWTH = 1.25
"""Factor by which the number of Gaussians grows in a round with ``--size auto``, if the rounds before the next cap
are enough to reach this one (measured: docs/experiments/size.md)."""

MOST_GROWTH = 2.0
"""Largest factor of a round with ``--size auto``: every Gaussian is split."""


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
    """Rounds at equal intervals, and growth by equal factors to the cap.

    With ``--size auto``, which raises the cap step by step, the factor is `GROWTH`, and larger only where the cap is
    far away: a scene of few points. Runs shorter than `FEWEST_ITERATIONS` have shorter intervals, in proportion: as
    many rounds as that run, and as much growth.

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
        self.stepwise = config.size == "auto"
        share = min(1.0, config.iterations / FEWEST_ITERATIONS) if self.stepwise else 1.0
        self.every, self.growth = max(1, round(settings.every * share)), settings.growth
        self.rounds = round(WINDOW * config.iterations) // self.every
        self.start = config.shortened(settings.start)
        self.full = round(settings.full_fraction * config.iterations)
        self.stop = round(settings.stop_fraction * config.iterations)

    def due(self, iteration: int) -> bool:
        """Whether a round is due after an iteration, counted from 1."""
        return self.start <= iteration < self.stop and iteration % self.every == 0

    def count_after(self, iteration: int, n: int, cap: int) -> int:
        """Number of Gaussians after a round that began with n.

        With ``--size auto`` it grows by `GROWTH`, or as much as reaches the cap one round before the next one, up to
        `MOST_GROWTH`. Otherwise it grows by a fixed fraction, and by at least the
        equal factor that reaches the cap in the remaining rounds of the growth phase. It never falls.
        """
        if n >= cap:
            return n
        if self.stepwise:
            factor = (cap / n) ** (1 / max(1, self.rounds - 1))
            return min(cap, ceil(n * min(MOST_GROWTH, max(GROWTH, factor))))
        rounds = max(1, self.full // self.every - iteration // self.every + 1)
        return min(cap, round(n * max(1 + self.growth, (cap / n) ** (1 / rounds))))
