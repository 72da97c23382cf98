"""Schedule of strategies that grow to a cap: iterations of the rounds, and the number of Gaussians after each."""

from math import ceil
from typing import Protocol

from clsplat.config import TrainConfig
from clsplat.errors import InputError

WINDOW = 0.1
"""Fraction of the iterations after which ``--size auto`` raises the cap, and between two rounds of the strategy error
at the cap. More rounds replace too much (measured: docs/experiments/strategies.md)."""

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
    def growth(self) -> float: ...
    @property
    def full_fraction(self) -> float: ...


class Schedule:
    """Rounds at intervals, and growth by equal factors to the cap.

    One round is due where growth ends, so that with ``--size auto``, which raises the cap in windows that end there,
    growth comes first in a window. The factor is `GROWTH` then, and larger only where the cap is far away: a scene of
    few points.

    Parameters
    ----------
    config : TrainConfig
    settings : Growth
    growing, every : int
        Iterations between two rounds, until growth ends and afterwards.

    Raises
    ------
    InputError
        If there is no cap to grow to.
    """

    def __init__(self, config: TrainConfig, settings: Growth, growing: int, every: int) -> None:
        if config.max_gaussians is None and config.size == "fixed":
            raise InputError(
                f"--max-gaussians: expected with --strategy {config.strategy}, which grows to that number, found "
                "none; --size auto finds one"
            )
        self.stepwise = config.size == "auto"
        self.growing, self.every, self.growth = growing, every, settings.growth
        self.rounds = round(WINDOW * config.iterations) // growing
        self.start = config.shortened(settings.start)
        self.full = round(settings.full_fraction * config.iterations)
        self.stop = round(settings.stop_fraction * config.iterations)

    def due(self, iteration: int) -> bool:
        """Whether a round is due after an iteration, counted from 1."""
        interval = self.growing if iteration < self.full else self.every
        return self.start <= iteration < self.stop and (iteration - self.full) % interval == 0

    def count_after(self, iteration: int, n: int, cap: int) -> int:
        """Number of Gaussians after a round that began with n.

        With ``--size auto`` it grows by `GROWTH`, or as much as reaches the cap one round before the next one, up to
        `MOST_GROWTH`. Otherwise it grows by a fixed fraction, and by at least the equal factor that reaches the cap
        in the remaining rounds of growth. It never falls.
        """
        if n >= cap:
            return n
        if self.stepwise:
            factor = (cap / n) ** (1 / max(1, self.rounds - 1))
            return min(cap, ceil(n * min(MOST_GROWTH, max(GROWTH, factor))))
        rounds = max(0, self.full - iteration) // self.growing + 1
        return min(cap, round(n * max(1 + self.growth, (cap / n) ** (1 / rounds))))
