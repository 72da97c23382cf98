"""The rule of ``--size auto``: how many Gaussians a scene needs (docs/size.md).

Blocks of pixels of some training photos validate. A candidate is a number of Gaussians with its PSNR on these blocks
and a price per doubling of the number. Candidates are compared in trials: two copies of the scene that differ only in
the number of Gaussians train for the same iterations, and the better one continues. The trials of the first half of a
run add Gaussians; later ones remove the Gaussians of the lowest price of removal. The degree of the spherical
harmonics is chosen by the same price per doubling of the bytes. At the end all pixels train.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil, inf, log2, sqrt
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config import TrainConfig
from clsplat.scene import View
from clsplat.training.densify.schedule import GROWTH_SHORTEST, TRIAL_GROWTH, TRIAL_LENGTH, growth_window
from clsplat.training.densify.strategy import MOST_GAUSSIANS
from clsplat.training.rows import Rows

GROWTH_END = 0.5
"""Fraction of the iterations at which trials of growth end, as the paper's densification does."""

PRUNING_START = 0.6
"""Fraction of the iterations at which trials of pruning begin. At the high learning rates before, the gain of more
Gaussians is underestimated (measured: docs/size.md)."""

PRUNING_END = 0.85
"""Fraction of the iterations at which trials of pruning end; all pixels train afterwards."""

GROWTH_START = 500
"""Iterations before the first trial of growth in a run of full length, as before the strategies' first rounds."""

SURE = 3.0
"""Standard errors by which the larger side of a trial of growth must be worse to be rejected. Superfluous growth
costs time and is pruned later; growth that is wrongly rejected costs quality."""

GROWTH_WINDOWS = 2
"""Windows in a trial of growth: the larger side grows in the first and settles in the second, since Gaussians that
have just been split are worse before they are better (measured: docs/size.md)."""

OUTLIERS = 0.25
"""Fraction of the photos, at either end of the sorted gains, that the trimmed mean leaves out."""

VALIDATIONS = 2
"""Validations of each side of a trial, which are averaged: PSNR fluctuates while the learning rates are high
(measured: docs/size.md)."""

FIRST_PRUNING = 0.5
"""Halvings of the number of Gaussians in the first trial of pruning."""

LAST_PRUNING = 0.125
"""Halvings of the number of Gaussians below which no trial is made: 8 % of the Gaussians."""

RANDOM_START = 10_000
"""Gaussians of a random start. Few are enough, since they only have to fill the scene before growth adds detail."""


class Candidate(NamedTuple):
    """A validated number of Gaussians.

    iteration: the one before which it was validated; n: Gaussians; sh_degree: degree of their spherical harmonics;
    psnr: mean over the validation photos, dB; views: PSNR of each photo, dB; cost: price of the bytes, dB.
    """

    iteration: int
    n: int
    sh_degree: int
    psnr: float
    views: list[float]
    cost: float

    @property
    def worth(self) -> float:
        """PSNR less the cost, dB, by which the degrees of the spherical harmonics of one scene are compared."""
        return self.psnr - self.cost


class Trial(NamedTuple):
    """Two candidates after the same iterations from the same scene: the larger one has grown, or the smaller one has
    been pruned."""

    grows: bool
    smaller: Candidate
    larger: Candidate

    @property
    def gain(self) -> float:
        """Gain of the larger candidate, dB: the mean over the middle half of the photos. Single photos differ by
        chance in blocks that few other photos show."""
        gains, out = self._gains()
        return float(gains[out : len(gains) - out].mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the gain, dB: that of a trimmed mean of paired differences (Tukey and McLaughlin
        1963)."""
        gains, out = self._gains()
        n = len(gains)
        return float(gains.clip(gains[out], gains[n - 1 - out]).std(ddof=1) / (1 - 2 * out / n) / sqrt(n))

    def _gains(self) -> tuple[NDArray[np.float64], int]:
        """Sorted gains of the photos, and the number of them left out at either end."""
        gains = np.sort(np.array(self.larger.views) - np.array(self.smaller.views))
        return gains, int(OUTLIERS * len(gains))

    @property
    def price(self) -> float:
        """Price of the larger candidate's additional Gaussians, dB."""
        return self.larger.cost - self.smaller.cost

    @property
    def takes_smaller(self) -> bool:
        """Whether the smaller candidate continues.

        After pruning it does if the price of the removed Gaussians is at least their gain. After growth it does only
        if the larger one is worse beyond chance, since growth pays late, and superfluous growth is pruned.
        """
        if self.grows:
            return self.larger.n <= self.smaller.n or -self.gain > SURE * self.standard_error
        return self.gain <= self.price


class SmallSide(NamedTuple):
    """The smaller side of a trial, which is trained first: its rows on the host, and its candidate."""

    rows: Rows
    candidate: Candidate


@dataclass(frozen=True)
class Search:
    """The state of the search.

    most: largest number of Gaussians after an edit; trials: those that have ended; degrees: candidates for the degree
    of the spherical harmonics; settled: the iteration before which the search ended, 0 until then; validated: PSNR of
    the photos at each validation of the larger side of the current trial; small_side: the smaller side of that trial.
    """

    most: int
    trials: list[Trial] = field(default_factory=list)
    degrees: list[Candidate] = field(default_factory=list)
    settled: int = 0
    validated: list[list[float]] = field(default_factory=list)
    small_side: SmallSide | None = None

    def validates(self, iteration: int) -> bool:
        """Whether blocks of photos validate instead of training in an iteration: up to the one in which it
        settles."""
        return not self.settled or iteration <= self.settled


def sh_bytes(sh_degree: int) -> int:
    """Bytes of a Gaussian in single precision, by the degree of its spherical harmonics."""
    return 4 * (11 + 3 * (sh_degree + 1) ** 2)


def trial_bounds(config: TrainConfig) -> list[int]:
    """Iterations before which trials begin or end: of growth, and from `first_pruning` on of pruning."""
    first, length = first_pruning(config), max(1, round(TRIAL_LENGTH * config.iterations))
    pruning = range(first, max(first, round(PRUNING_END * config.iterations)) + 1, length)
    earliest, window = config.shortened(GROWTH_START), GROWTH_WINDOWS * growth_window(config)
    growth = range(round(GROWTH_END * config.iterations), earliest - 1, -window)
    return [*growth[::-1], *pruning]


def validation_times(config: TrainConfig) -> set[int]:
    """Iterations before which both sides of a trial are validated: from its middle to its end."""
    ends = pairwise(trial_bounds(config))
    return {end - round(k * (end - begin) / 2 / VALIDATIONS) for begin, end in ends for k in range(VALIDATIONS)}


def first_pruning(config: TrainConfig) -> int:
    """Iteration before which the first trial of pruning begins."""
    return max(1, round(PRUNING_START * config.iterations))


def candidate(iteration: int, n: int, sh_degree: int, validated: list[list[float]], config: TrainConfig) -> Candidate:
    """Make a candidate from the PSNR of each photo at each validation, dB."""
    views = [float(view) for view in np.mean(validated, axis=0)]
    cost = config.size_price * log2(n * sh_bytes(sh_degree))
    return Candidate(iteration, n, sh_degree, float(np.mean(views)), views, cost)


def most_identifiable(views: list[View], config: TrainConfig) -> int:
    """Number of Gaussians with as many parameters as the photos have values: the photos cannot determine more."""
    values = 3 * sum(v.image[:, :, 0].size if v.mask is None else int(v.mask.sum()) for v in views)
    return min(config.max_gaussians or MOST_GAUSSIANS, max(1, values * 4 // sh_bytes(config.init.sh_degree)))


Decision = Literal["grow", "try", "rest", "prune", "settle"]
"""Next phase of a search: growth without or with a trial, no change, a trial of pruning, or the end."""


def next_phase(search: Search, iteration: int, config: TrainConfig, most: int) -> Decision:
    """Decide what follows one of the `trial_bounds`; growth goes up to `most` Gaussians."""
    grown = [trial for trial in search.trials if trial.grows]
    if iteration < first_pruning(config):
        if search.most >= most or iteration >= round(GROWTH_END * config.iterations):
            return "rest"
        return "try" if search.most >= surely_too_few(grown, config.size_price) else "grow"
    late = iteration == trial_bounds(config)[-1]
    return "settle" if late or halvings(search.trials) < LAST_PRUNING else "prune"


def most_grown(search: Search, phase: Decision, config: TrainConfig, most: int) -> int:
    """Largest number of Gaussians that growth may reach in the next phase.

    In short runs, whose windows hold less than one round of growth, a trial has no window to settle in.
    """
    if phase not in ("try", "grow"):
        return search.most
    settles = phase == "try" and TRIAL_LENGTH * config.iterations >= GROWTH_SHORTEST
    factor = TRIAL_GROWTH ** (1 if settles else GROWTH_WINDOWS)
    grown = [trial for trial in search.trials if trial.grows]
    sure = surely_too_few(grown, config.size_price) if phase == "grow" else inf
    return ceil(min(factor * search.most, sure, most))


def halvings(trials: list[Trial]) -> float:
    """Halvings of the number of Gaussians in the next trial of pruning: twice those of the last one if it was
    accepted, half of them otherwise."""
    result = FIRST_PRUNING
    for trial in trials:
        if not trial.grows:
            result *= 2 if trial.takes_smaller else 0.5
    return result


def surely_too_few(grown: list[Trial], price: float) -> float:
    """Number of Gaussians below which growth needs no trial, from the gain of the last trial of growth.

    The gain per doubling falls by about half from doubling to doubling (docs/size.md): a gain g reaches the price p
    after log2(g / p) doublings. Half of these doublings need no trial.
    """
    if not grown:
        return 0
    smaller, larger = grown[-1].smaller, grown[-1].larger
    if larger.n <= smaller.n:  # nothing has grown
        return 0
    gain = grown[-1].gain / log2(larger.n / smaller.n)
    if gain <= price:
        return 0
    return larger.n * sqrt(gain / price) if price else inf
