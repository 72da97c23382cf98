"""The rule of ``--size auto``: how many Gaussians a scene needs (docs/size.md).

Some training photos are held back. A candidate is a number of Gaussians with its quality on these photos and a price
per doubling of the number. The scene grows until growth stops paying on the held-back photos, and returns to the last
candidate that did. Where more Gaussians were worse, trials of pruning compare the scene with a copy without those of
the lowest price of removal, trained for the same iterations. The degree of the spherical harmonics is lowered where
its bands lose by the same price per doubling of the bytes. After that all photos train.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil, log2, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config import TrainConfig
from clsplat.ranges import checked
from clsplat.scene import Scene
from clsplat.training.densify.schedule import WINDOW
from clsplat.training.densify.strategy import MOST_GAUSSIANS
from clsplat.training.rows import Rows
from clsplat.training.run_length import SMALL_PHOTO, detail, largest_photo

GROWTH_END = 0.4
"""Fraction of the iterations at which growth ends. The paper's densification ends at 0.5; the photos that are held
back train longer if growth ends earlier (measured: docs/experiments/size.md)."""

TRIAL_LENGTH = 0.05
"""Fraction of the iterations in a trial of pruning."""

TRIAL_RATES = 0.3
"""Factor on the learning rates in trials of pruning. Large steps make each Gaussian fluctuate, and the error by this
grows with their number, so that the smaller side would win (measured: docs/experiments/size.md)."""

PRUNING_END = 0.55
"""Fraction of the iterations at which trials of pruning end; all photos train afterwards."""

GROWTH_START = 500
"""Iterations before the first validation in a run of full length, as before the strategies' first rounds."""

SURE = 1.0
"""Standard errors by which the gain of the larger of two candidates must exceed its price: of those that cannot be
told apart, the smaller one is taken (the one-standard-error rule of Breiman et al. 1984, "Classification and
Regression Trees", section 3.4.3)."""

NORMAL_DEVIATIONS = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

PATIENCE = 2.0
"""Factor by which the number of Gaussians grows without paying before growth ends."""

PACE = 3.0
"""Multiple of the first Gaussians, or of the sparse points if these are fewer, that growth reaches by its end, unless
`PER_PIXEL` allows more. Faster growth ends worse (measured: docs/experiments/size.md)."""

PER_PIXEL = 1.0
"""Gaussians per pixel of a small photo that growth reaches by its end, unless `PACE` allows more. Larger photos allow
more in proportion to the root of their edges (measured: docs/benchmarks.md)."""

CHEAPEST = 16.0
"""Largest factor by which a low price raises the number of Gaussians that growth may reach."""

VALIDATIONS = 3
"""Validations in the second half of a window, which are averaged: quality fluctuates while the learning rates are
high."""

FEWEST_PRUNING = 4
"""Fewest held-back photos that decide on pruning: by fewer a scene is halved that then loses in other photos
(measured: docs/experiments/size.md)."""

HALVING = 0.5
"""Fraction of the Gaussians that a trial of pruning leaves."""

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

    @classmethod
    def restored(cls, saved: list[Any]) -> "Candidate":
        """A candidate from its fields, as JSON gives them; other values raise TypeError or ValueError."""
        iteration, n, sh_degree, quality, views, cost = saved
        for number in (iteration, n, sh_degree):
            checked(number, int, "candidate")
        if min(iteration, n, sh_degree) < 0:
            raise ValueError(f"candidate {saved}")
        return cls(iteration, n, sh_degree, float(quality), [float(view) for view in views], float(cost))

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
    def gains(self) -> NDArray[np.float64]:
        """Gain of the larger candidate in each photo, dB."""
        return np.array(self.larger.views) - np.array(self.smaller.views)

    @property
    def gain(self) -> float:
        """Gain of the larger candidate, dB: the median over the photos.

        A single Gaussian in front of one camera, which comes and goes, would decide by the mean (docs/size.md).
        """
        return float(np.median(self.gains))

    @property
    def margin(self) -> float:
        """`SURE` standard errors of the gain, dB.

        The spread of the gains is the smaller one of their standard deviation and of what their median deviation
        tells, which single photos do not raise. The median of two is their mean, and has its error.
        """
        gains = self.gains
        deviation = NORMAL_DEVIATIONS * float(np.median(np.abs(gains - self.gain)))
        return SURE * min(float(gains.std(ddof=1)), deviation) / sqrt(len(gains))

    @property
    def price(self) -> float:
        """Price of the larger candidate's additional Gaussians, dB."""
        return self.larger.cost - self.smaller.cost

    @property
    def takes_smaller(self) -> bool:
        """Whether the smaller candidate continues: unless the larger one gains more than its price, beyond chance."""
        return self.gain <= self.price + self.margin

    @property
    def larger_loses(self) -> bool:
        """Whether the larger candidate gains less than its price, beyond chance."""
        return self.gain <= self.price - self.margin


class SmallSide(NamedTuple):
    """The smaller candidate of a comparison, with its rows on the host: the last one whose growth paid, or the pruned
    side of a trial, which is trained first."""

    rows: Rows
    candidate: Candidate


@dataclass(frozen=True)
class Search:
    """The state of the search.

    most: largest number of Gaussians after an edit; pace: factor of its growth from window to window; grows: whether
    growth has not ended; trials: comparisons so far; degrees: candidates for the degree of the spherical harmonics;
    settled: the iteration before which the search ended, 0 until then; validated: quality of the photos at each
    validation in the current window; small_side: what the end of the window is compared with.
    """

    most: int
    pace: float = 1.0
    grows: bool = True
    trials: list[Trial] = field(default_factory=list)
    degrees: list[Candidate] = field(default_factory=list)
    settled: int = 0
    validated: list[list[float]] = field(default_factory=list)
    small_side: SmallSide | None = None

    @classmethod
    def restored(cls, saved: dict[str, Any], small_side: SmallSide | None) -> "Search":
        """A search from its fields, as JSON gives them; other values raise KeyError, TypeError or ValueError."""
        trials = [
            Trial(checked(grows, bool, "grows"), Candidate.restored(smaller), Candidate.restored(larger))
            for grows, smaller, larger in saved["trials"]
        ]
        validated = [[float(view) for view in views] for views in saved["validated"]]
        sizes = {len(c.views) for trial in trials for c in (trial.smaller, trial.larger)} | {*map(len, validated)}
        search = cls(
            most=checked(saved["most"], int, "most"),
            pace=checked(saved["pace"], float, "pace"),
            grows=checked(saved["grows"], bool, "grows"),
            trials=trials,
            degrees=[Candidate.restored(degree) for degree in saved["degrees"]],
            settled=checked(saved["settled"], int, "settled"),
            validated=validated,
            small_side=small_side,
        )
        if len(sizes) > 1 or search.most < 1 or search.pace <= 0 or search.settled < 0:
            raise ValueError(f"search {saved}")
        return search

    @property
    def growth(self) -> Trial | None:
        """The last comparison of growth."""
        return next((trial for trial in reversed(self.trials) if trial.grows), None)

    def holds_back(self, iteration: int) -> bool:
        """Whether photos are held back in an iteration: up to the one in which the search settles."""
        return not self.settled or iteration <= self.settled

    def rates(self, iteration: int, config: TrainConfig) -> float:
        """Factor on the learning rates in an iteration."""
        tries = not self.settled and iteration >= first_pruning(config)
        return TRIAL_RATES if tries else 1.0


def sh_bytes(sh_degree: int) -> int:
    """Bytes of a Gaussian in single precision, by the degree of its spherical harmonics."""
    return 4 * (11 + 3 * (sh_degree + 1) ** 2)


def window_bounds(config: TrainConfig) -> list[int]:
    """Iterations before which windows begin or end: of growth, and from `first_pruning` on trials of pruning."""
    first, length = first_pruning(config), max(1, round(TRIAL_LENGTH * config.iterations))
    pruning = range(first, max(first, round(PRUNING_END * config.iterations)) + 1, length)
    return [*growth_bounds(config)[:-1], *pruning]


def growth_bounds(config: TrainConfig) -> list[int]:
    """Iterations before which windows of growth end."""
    earliest, last = config.shortened(GROWTH_START), round(GROWTH_END * config.iterations)
    return [*range(last, earliest - 1, -growth_window(config))][::-1]


def growth_window(config: TrainConfig) -> int:
    """Iterations in a window of growth.

    In its first part the number of Gaussians grows, in its second half the scene is validated: Gaussians that have
    just been split are worse before they are better.
    """
    return max(1, round(WINDOW * config.iterations))


def start(scene: Scene, n: int, config: TrainConfig) -> "Search":
    """The search before the first iteration, with n Gaussians."""
    growing = max(1, len(growth_bounds(config)) - 1)  # the first window has the first Gaussians
    sparse = min(n, len(scene.points) or n)  # dense points fill what growth may reach, and do not extend it
    return Search(n, max(full_size(scene, sparse, config) / n, 1.0) ** (1 / growing))


def full_size(scene: Scene, sparse: int, config: TrainConfig) -> float:
    """Number of Gaussians that growth may reach by its end, by the sparse points, the photos and the price."""
    return max(PACE * sparse * cheapness(config), reach(scene, config))


def reach(scene: Scene, config: TrainConfig) -> float:
    """Number of Gaussians that growth may reach by its end, by the photos and the price."""
    return PER_PIXEL * min(largest_photo(scene), SMALL_PHOTO) * detail(scene) * cheapness(config)


def cheapness(config: TrainConfig) -> float:
    """Factor by which a price below the default raises the number of Gaussians that growth may reach."""
    default = TrainConfig.size_price
    return default / min(default, max(config.size_price, default / CHEAPEST))


def validation_times(config: TrainConfig) -> set[int]:
    """Iterations before which a scene is validated: from the middle of a window to its end."""
    bounds = window_bounds(config)
    ends = pairwise([max(1, bounds[0] - growth_window(config)), *bounds])
    return {end - round(k * (end - begin) / 2 / VALIDATIONS) for begin, end in ends for k in range(VALIDATIONS)}


def first_pruning(config: TrainConfig) -> int:
    """Iteration before which growth has ended and the first trial of pruning begins."""
    return max(1, round(GROWTH_END * config.iterations))


def candidate(iteration: int, n: int, sh_degree: int, validated: list[list[float]], config: TrainConfig) -> Candidate:
    """Make a candidate from the quality of each photo at each validation, dB."""
    views = [float(view) for view in np.mean(validated, axis=0)]
    cost = config.size_price * log2(n * sh_bytes(sh_degree))
    return Candidate(iteration, n, sh_degree, float(np.mean(views)), views, cost)


def best_degree(degrees: list[Candidate]) -> Candidate:
    """The degree of the spherical harmonics to continue with: the one of the largest worth, of those to which the
    highest one loses beyond chance; the highest one if there is none.

    Bands that have trained for a short time seem to be worth less than at the end of a run (measured:
    docs/experiments/size.md).
    """
    highest = degrees[-1]
    better = [lower for lower in degrees[:-1] if Trial(False, lower, highest).larger_loses]
    return max(better, key=lambda c: c.worth, default=highest)


def growth_ends(search: Search, n: int, iteration: int, config: TrainConfig) -> bool:
    """Whether growth to n Gaussians has not paid for too long, or its time is over."""
    paid = search.small_side.candidate.n if search.small_side else n
    return iteration >= first_pruning(config) or n >= PATIENCE * paid or n >= most_allowed(config)


def most_allowed(config: TrainConfig) -> int:
    """The user's limit of the number of Gaussians."""
    return config.max_gaussians or MOST_GAUSSIANS


def most_grown(search: Search, config: TrainConfig) -> int:
    """Largest number of Gaussians that growth may reach in the next window."""
    return min(ceil(search.pace * search.most), most_allowed(config)) if search.grows else search.most


def most_with_all(search: Search, trained: int, photos: int, config: TrainConfig) -> int:
    """Largest number of Gaussians once all photos train, not only `trained` of them.

    Unless growth ended since it did not pay, it is in proportion to the photos: what only those show that were held
    back has few Gaussians until then.
    """
    if search.growth and search.growth.takes_smaller:
        return search.most
    return min(ceil(search.most * photos / trained), most_allowed(config))


def prunes(search: Search, iteration: int, held: int, config: TrainConfig) -> bool:
    """Whether a trial of pruning begins at one of the `window_bounds`: until one is rejected or time is over.

    Only where growth lost beyond chance, and with at least `FEWEST_PRUNING` held-back photos: in the middle of a run,
    few Gaussians seem as good as the many that are better at its end (measured: docs/experiments/size.md).
    """
    rejected = any(not trial.grows and not trial.takes_smaller for trial in search.trials)
    tries = held >= FEWEST_PRUNING and search.growth is not None and search.growth.larger_loses
    return tries and not rejected and iteration < window_bounds(config)[-1]
