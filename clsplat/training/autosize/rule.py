"""The rule of ``--size auto``: how many Gaussians a scene needs (docs/size.md).

Some training photos are held back. A candidate is a number of Gaussians with its quality on these photos and a price
per doubling of the number. The scene grows until growth stops paying on the held-back photos, and returns to the last
candidate that did. Then trials of pruning compare it with a copy without the Gaussians of the lowest price of removal,
trained for the same iterations. The degree of the spherical harmonics is chosen by the same price per doubling of the
bytes. After that all photos train.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil, log2, sqrt
from typing import Literal, NamedTuple

import numpy as np

from clsplat.config import TrainConfig
from clsplat.training.densify.schedule import TRIAL_GROWTH, TRIAL_LENGTH, growth_window
from clsplat.training.densify.strategy import MOST_GAUSSIANS
from clsplat.training.rows import Rows

GROWTH_END = 0.5
"""Fraction of the iterations at which growth ends, as the paper's densification does."""

PRUNING_START = 0.6
"""Fraction of the iterations at which trials of pruning begin. At the high learning rates before, the gain of more
Gaussians is underestimated (measured: docs/size.md)."""

PRUNING_END = 0.75
"""Fraction of the iterations at which trials of pruning end; all photos train afterwards."""

GROWTH_START = 500
"""Iterations before the first validation in a run of full length, as before the strategies' first rounds."""

SURE = 1.0
"""Standard errors by which the gain of the larger of two candidates must exceed its price (the one-standard-error
rule of Breiman et al. 1984, "Classification and Regression Trees", section 3.4.3), and by which that of a scene before
pruning must stay below it."""

PATIENCE = 2.0
"""Factor by which the number of Gaussians grows without paying before growth ends."""

VALIDATIONS = 2
"""Validations in a window, which are averaged: quality fluctuates while the learning rates are high (measured:
docs/size.md)."""

FIRST_PRUNING = 1.0
"""Halvings of the number of Gaussians in the first trial of pruning."""

LAST_PRUNING = 0.5
"""Fewest halvings of the number of Gaussians that a trial is made for."""

RANDOM_START = 10_000
"""Gaussians of a random start. Few are enough, since they only have to fill the scene before growth adds detail."""


class Candidate(NamedTuple):
    """A validated number of Gaussians.

    iteration: the one before which it was validated; n: Gaussians; sh_degree: degree of their spherical harmonics;
    quality: mean over the held-back photos, dB; views: quality of each photo, dB; cost: price of the bytes, dB.
    """

    iteration: int
    n: int
    sh_degree: int
    quality: float
    views: list[float]
    cost: float

    @property
    def worth(self) -> float:
        """Quality less the cost, dB, by which the degrees of the spherical harmonics of one scene are compared."""
        return self.quality - self.cost


class Trial(NamedTuple):
    """Two candidates: the larger one has grown from the smaller one, or the smaller one has been pruned and both have
    trained for the same iterations since."""

    grows: bool
    smaller: Candidate
    larger: Candidate

    @property
    def gain(self) -> float:
        """Gain of the larger candidate, dB: the mean over the photos."""
        return self.larger.quality - self.smaller.quality

    @property
    def standard_error(self) -> float:
        """Standard error of the gain, dB, from the differences of the photos."""
        gains = np.array(self.larger.views) - np.array(self.smaller.views)
        return float(gains.std(ddof=1) / sqrt(len(gains)))

    @property
    def price(self) -> float:
        """Price of the larger candidate's additional Gaussians, dB."""
        return self.larger.cost - self.smaller.cost

    @property
    def takes_smaller(self) -> bool:
        """Whether the smaller candidate continues.

        A change must be earned: growth has to gain more than its price beyond chance, and what pruning loses must be
        below the price beyond chance.
        """
        margin = SURE * self.standard_error
        return self.gain <= self.price + (margin if self.grows else -margin)


class SmallSide(NamedTuple):
    """The smaller candidate of a comparison, with its rows on the host: the last one whose growth paid, or the pruned
    side of a trial, which is trained first."""

    rows: Rows
    candidate: Candidate


@dataclass(frozen=True)
class Search:
    """The state of the search.

    most: largest number of Gaussians after an edit; grows: whether growth has not ended; trials: comparisons so far;
    degrees: candidates for the degree of the spherical harmonics; settled: the iteration before which the search
    ended, 0 until then; validated: quality of the photos at each validation in the current window; small_side: what
    the end of the window is compared with.
    """

    most: int
    grows: bool = True
    trials: list[Trial] = field(default_factory=list)
    degrees: list[Candidate] = field(default_factory=list)
    settled: int = 0
    validated: list[list[float]] = field(default_factory=list)
    small_side: SmallSide | None = None

    def holds_back(self, iteration: int) -> bool:
        """Whether photos are held back in an iteration: up to the one in which the search settles."""
        return not self.settled or iteration <= self.settled


def sh_bytes(sh_degree: int) -> int:
    """Bytes of a Gaussian in single precision, by the degree of its spherical harmonics."""
    return 4 * (11 + 3 * (sh_degree + 1) ** 2)


def window_bounds(config: TrainConfig) -> list[int]:
    """Iterations before which windows begin or end: of growth, and from `first_pruning` on trials of pruning."""
    first, length = first_pruning(config), max(1, round(TRIAL_LENGTH * config.iterations))
    pruning = range(first, max(first, round(PRUNING_END * config.iterations)) + 1, length)
    earliest, window = config.shortened(GROWTH_START), growth_window(config)
    growth = range(round(GROWTH_END * config.iterations), earliest - 1, -window)
    return [*growth[::-1], *pruning]


def validation_times(config: TrainConfig) -> set[int]:
    """Iterations before which a scene is validated: from the middle of a window to its end."""
    bounds = window_bounds(config)
    ends = pairwise([max(1, bounds[0] - growth_window(config)), *bounds])
    return {end - round(k * (end - begin) / 2 / VALIDATIONS) for begin, end in ends for k in range(VALIDATIONS)}


def first_pruning(config: TrainConfig) -> int:
    """Iteration before which the first trial of pruning begins."""
    return max(1, round(PRUNING_START * config.iterations))


def candidate(iteration: int, n: int, sh_degree: int, validated: list[list[float]], config: TrainConfig) -> Candidate:
    """Make a candidate from the quality of each photo at each validation, dB."""
    views = [float(view) for view in np.mean(validated, axis=0)]
    cost = config.size_price * log2(n * sh_bytes(sh_degree))
    return Candidate(iteration, n, sh_degree, float(np.mean(views)), views, cost)


def growth_ends(search: Search, n: int, iteration: int, config: TrainConfig) -> bool:
    """Whether growth to n Gaussians has not paid for too long, or its time is over."""
    paid = search.small_side.candidate.n if search.small_side else n
    late = iteration >= round(GROWTH_END * config.iterations)
    return late or n >= PATIENCE * paid or n >= most_allowed(config)


def most_allowed(config: TrainConfig) -> int:
    """The user's limit of the number of Gaussians."""
    return config.max_gaussians or MOST_GAUSSIANS


def most_grown(search: Search, config: TrainConfig) -> int:
    """Largest number of Gaussians that growth may reach in the next window."""
    return min(ceil(TRIAL_GROWTH * search.most), most_allowed(config)) if search.grows else search.most


Decision = Literal["rest", "prune", "settle"]
"""Next phase of a search whose growth has ended: no change, a trial of pruning, or the end."""


def next_phase(search: Search, iteration: int, config: TrainConfig) -> Decision:
    """Decide what follows one of the `window_bounds` once growth has ended."""
    if iteration < first_pruning(config):
        return "rest"
    late = iteration == window_bounds(config)[-1]
    return "settle" if late or halvings(search.trials) < LAST_PRUNING else "prune"


def halvings(trials: list[Trial]) -> float:
    """Halvings of the number of Gaussians in the next trial of pruning: halved by each trial that was rejected."""
    rejected = sum(not trial.grows and not trial.takes_smaller for trial in trials)
    return FIRST_PRUNING / 2**rejected
