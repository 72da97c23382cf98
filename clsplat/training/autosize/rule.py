"""How many Gaussians a scene needs: chosen from its photos (docs/size.md).

Parts of some training photos validate. A size is worth its PSNR on them less a price for each doubling of the
Gaussians, and sizes are compared in trials: two copies of the scene that differ in nothing but their size train for
the same iterations, and the one that is worth more goes on. In the first half of a run the trials are of growth,
then of Gaussians removed by price. The degree of the spherical harmonics is chosen by the same price on bytes. At the
end all pixels train.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import ceil, inf, log2, log10, sqrt
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.pruning.prices import price, removal_order, with_degree, without_bands
from clsplat.render import render_views
from clsplat.scene import View
from clsplat.training.densify.schedule import GROWTH_SHORTEST, TRIAL_GROWTH, TRIAL_LENGTH, growth_window
from clsplat.training.densify.strategy import MOST_GAUSSIANS
from clsplat.training.optimizer import Moments

if TYPE_CHECKING:
    from clsplat.device import Device

VALIDATING = 12
"""Training photos, evenly spaced, of which parts validate while the size is sought: no viewpoint is missing, as it is
where whole photos are held back, and an error of the mean is that of so many."""

FEWEST_VALIDATING = 2
"""At least so many must have pixels that validate: a difference of one has no error that can be told."""

BLOCKS = 8
"""Blocks along each edge of such a photo."""

EVERY_BLOCK = 4
"""Every fourth block of a row validates, two further on in the next row and one in the next photo."""

FEWEST_PHOTOS = 8
"""With fewer photos to train on, every one is needed: the size is not sought."""

GROWTH_END = 0.5
"""Fraction of the iterations at which trials of growth end: the paper's densification ends there."""

PRUNING_START = 0.6
"""Fraction at which trials of pruning begin, with learning rates that have come down. At high ones more Gaussians
show nothing of what they are worth in the end: on fox_pinhole at 135x240 trials at 0.5 to 0.8 of 7000 iterations went
down to 24 600 Gaussians, 0.4 dB below 64 000."""

PRUNING_END = 0.85
"""Fraction by which they end: all pixels train for the rest."""

GROWTH_START = 500
"""Iterations before the first trial of growth, fewer in short runs, as before the strategies' first rounds."""

SURE = 3.0
"""Standard errors by which growth must lose: growth that is kept in vain costs time, and is pruned; growth that is
wrongly lost costs quality."""

GROWTH_WINDOWS = 2
"""Windows of growth in a trial of it: the larger side grows in the first and settles in the second. Without the
second it lost 0.05 and 0.47 dB in the first trials of lego (200x200, 7000 iterations), and gained 0.16 with it: what
has just been split is worse before it is better."""

PERFECT = 20 * log10(255)
"""PSNR of an error of one level in 255: photos that are rendered better are rendered as well, or flat walls would be
given Gaussians for what nobody sees."""

OUTLIERS = 0.25
"""Fraction of the photos at either end that do not count."""

LOOKS = 2
"""Validations of each side of a trial, averaged: PSNR goes up and down while the learning rates are high. From single
looks at five photos of fox_pinhole the differences of sides had standard errors of 0.1 to 0.4 dB."""

FIRST_PRUNING = 0.5
"""Halvings of the Gaussians that the first trial of pruning is about."""

LAST_PRUNING = 0.125
"""Halvings below which no trial is made: 8 % of the Gaussians, and 6 thousandths of a dB at the default price."""

BAND_SHARES = (1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)
"""Of the bands that seem useless one by one. All of them together cost fox_pinhole 0.2 dB (135x240, 7000
iterations)."""

RANDOM_START = 10_000
"""Gaussians of a random start: fog, which the photos dissolve before it grows to what they show."""

PRICING = 24
PRICING_SHARE = 1 / 5
"""Photos by which Gaussians are priced, or of many photos this share: what few show has no price in the others."""


class Point(NamedTuple):
    """A size that was validated.

    iteration: before which; n Gaussians of a degree of the spherical harmonics; psnr: dB, the mean over the
    validation photos; views: of each. cost: the price of its bytes.
    """

    iteration: int
    n: int
    sh_degree: int
    psnr: float
    views: list[float]
    cost: float

    @property
    def worth(self) -> float:
        """What the degrees of one scene are compared by."""
        return self.psnr - self.cost


class Trial(NamedTuple):
    """Two sizes after the same iterations from the same scene, of which either the larger has grown or the smaller
    has been pruned."""

    grows: bool
    smaller: Point
    larger: Point

    @property
    def gain(self) -> float:
        """Of the larger side in dB, in the middle half of the photos. Now and then one is lucky by half a dB on one
        side, in a block that few others show: by the mean over all, 1024 Gaussians stayed where 128 are enough
        (tests/training/test_autosize.py)."""
        gains, out = self._gains()
        return float(gains[out : len(gains) - out].mean())

    @property
    def standard_error(self) -> float:
        """Of the gain, photo by photo since photos differ more than sizes do: that of a trimmed mean (Tukey and
        McLaughlin 1963)."""
        gains, out = self._gains()
        n = len(gains)
        return float(gains.clip(gains[out], gains[n - 1 - out]).std(ddof=1) / (1 - 2 * out / n) / sqrt(n))

    def _gains(self) -> tuple[NDArray[np.float64], int]:
        """The photos' gains from the least on, and how many of them do not count at either end."""
        gains = np.sort(np.array(self.larger.views) - np.array(self.smaller.views))
        return gains, int(OUTLIERS * len(gains))

    @property
    def price(self) -> float:
        """What the gain is measured against, in dB."""
        return self.larger.cost - self.smaller.cost

    @property
    def takes_smaller(self) -> bool:
        """Whether the smaller goes on: pruned, if the price saves more than it loses; against growth, which pays
        late and is pruned if it does not, only if the larger is worse by more than chance."""
        if self.grows:
            return self.larger.n <= self.smaller.n or -self.gain > SURE * self.standard_error
        return self.gain <= self.price


class Kept(NamedTuple):
    """What training goes back to: rows of one size, on the host."""

    gaussians: Gaussians
    moments: Moments
    statistics: dict[str, NDArray[Any]]

    def take(self, rows: NDArray[Any]) -> "Kept":
        """Some of the rows."""
        statistics = {name: array[rows] for name, array in self.statistics.items()}
        return Kept(self.gaussians.take(rows), self.moments.take(rows, np.zeros(len(rows), bool)), statistics)


class Rival(NamedTuple):
    """The smaller side of a trial, trained ahead, and what it came to."""

    kept: Kept
    point: Point


@dataclass
class Search:
    """The state of the search.

    most: Gaussians that an edit may leave; trials that have ended; degrees: of the spherical harmonics, in the scene
    that was chosen; settled: the iteration before which it was, 0 while it is sought; seen: PSNR of the validation
    photos at each look at the larger side of the trial that runs; rival: its smaller side.
    """

    most: int
    trials: list[Trial] = field(default_factory=list)
    degrees: list[Point] = field(default_factory=list)
    settled: int = 0
    seen: list[list[float]] = field(default_factory=list)
    rival: Rival | None = None


def split(views: list[View]) -> tuple[list[View], list[View]]:
    """The photos without the blocks that validate, and those that have such with nothing but them, in masks."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(VALIDATING, len(views))).round().astype(int))
    training, validation = list(views), []
    for k, i in enumerate(chosen):
        height, width = views[i].image.shape[:2]
        row, column = np.arange(height)[:, None] * BLOCKS // height, np.arange(width) * BLOCKS // width
        held = (column + 2 * row + k) % EVERY_BLOCK == 0
        counts = np.ones((height, width), bool) if views[i].mask is None else views[i].mask
        training[i] = replace(views[i], mask=counts & ~held)
        if (counts & held).any():
            validation.append(replace(views[i], mask=counts & held))
    return training, validation


def can_search(views: list[View]) -> bool:
    """Whether there are photos enough."""
    return len(views) >= FEWEST_PHOTOS and len(split(views)[1]) >= FEWEST_VALIDATING


def sh_bytes(sh_degree: int) -> int:
    """Bytes of a Gaussian with spherical harmonics of a degree, in single precision."""
    return 4 * (11 + 3 * (sh_degree + 1) ** 2)


def stops(config: TrainConfig) -> list[int]:
    """The iterations before which trials begin or end: of growth, and from `first_shrink` on of pruning."""
    first, length = first_shrink(config), max(1, round(TRIAL_LENGTH * config.iterations))
    shrinks = range(first, max(first, round(PRUNING_END * config.iterations)) + 1, length)
    earliest, window = config.shortened(GROWTH_START), GROWTH_WINDOWS * growth_window(config)
    grows = range(round(GROWTH_END * config.iterations), earliest - 1, -window)
    return [*grows[::-1], *shrinks]


def looks(config: TrainConfig) -> set[int]:
    """The iterations before which the two sides of a trial are validated: from its middle to its end."""
    ends = pairwise(stops(config))
    return {end - round(k * (end - begin) / 2 / LOOKS) for begin, end in ends for k in range(LOOKS)}


def first_shrink(config: TrainConfig) -> int:
    """The iteration before which the first trial of pruning begins."""
    return max(1, round(PRUNING_START * config.iterations))


def validate(
    gaussians: Gaussians, views: list[View], config: TrainConfig, device: "Device", sh_degree: int
) -> list[float]:
    """PSNR of each view, in dB and up to `PERFECT`, of renders rounded to 8 bits."""
    cameras = [view.camera for view in views]
    background = BACKGROUNDS[config.data.background]
    renderings = render_views(
        gaussians,
        cameras,
        config.render,
        device,
        background=background,
        sh_degree=min(sh_degree, gaussians.sh_degree),
    )
    pairs = zip(renderings, views, strict=True)
    return [min(PERFECT, psnr(to_uint8(rendering.rgb), view.image, view.mask)) for rendering, view in pairs]


def point(iteration: int, n: int, sh_degree: int, seen: list[list[float]], config: TrainConfig) -> Point:
    """What a size is worth by the PSNR of each photo at each look."""
    views = [float(view) for view in np.mean(seen, axis=0)]
    cost = config.size_price * log2(n * sh_bytes(sh_degree))
    return Point(iteration, n, sh_degree, float(np.mean(views)), views, cost)


def most_identifiable(views: list[View], config: TrainConfig) -> int:
    """The number of Gaussians that have as many parameters as the photos have values; more cannot be told apart."""
    values = 3 * sum(v.image[:, :, 0].size if v.mask is None else int(v.mask.sum()) for v in views)
    return min(config.max_gaussians or MOST_GAUSSIANS, max(1, values * 4 // sh_bytes(config.init.sh_degree)))


def next_trial(
    search: Search, iteration: int, config: TrainConfig, most: int
) -> Literal["grow", "try", "rest", "shrink", "settle"]:
    """What follows at one of the `stops`: growth with or without a trial, up to `most` Gaussians, pruning in one,
    nothing, or the end."""
    grown = [trial for trial in search.trials if trial.grows]
    if iteration < first_shrink(config):
        if search.most >= most or iteration >= round(GROWTH_END * config.iterations):
            return "rest"
        return "try" if search.most >= surely_short(grown, config.size_price) else "grow"
    late = iteration == stops(config)[-1]
    return "settle" if late or halvings(search.trials) < LAST_PRUNING else "shrink"


def most_grown(search: Search, todo: str, config: TrainConfig, most: int) -> int:
    """How many Gaussians a trial of growth, or the same time without one, may leave.

    Where windows hold less than a round, nothing settles: half the growth would be lost, and 0.27 dB of the demo's.
    """
    if todo not in ("try", "grow"):
        return search.most
    settles = todo == "try" and TRIAL_LENGTH * config.iterations >= GROWTH_SHORTEST
    factor = TRIAL_GROWTH ** (1 if settles else GROWTH_WINDOWS)
    grown = [trial for trial in search.trials if trial.grows]
    sure = surely_short(grown, config.size_price) if todo == "grow" else inf
    return ceil(min(factor * search.most, sure, most))


def halvings(trials: list[Trial]) -> float:
    """How much the next trial of pruning removes: twice as much as the last one if that was taken, else half."""
    result = FIRST_PRUNING
    for trial in trials:
        if not trial.grows:
            result *= 2 if trial.takes_smaller else 0.5
    return result


def surely_short(grown: list[Trial], price: float) -> float:
    """A number of Gaussians below which growth needs no trial, by what the last one gained.

    Gains per doubling fall by about half from doubling to doubling (docs/size.md): what gains g reaches the price
    p after log2(g / p) doublings. Growth is free for half of them.
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


def _some(views: list[Any]) -> list[Any]:
    return views[:: ceil(len(views) / max(PRICING, PRICING_SHARE * len(views)))]


def costliest_rows(
    gaussians: Gaussians, left: float, views: list[View], config: TrainConfig, device: "Device"
) -> NDArray[np.intp]:
    """A fraction of the rows, in their order: those that are removed last."""
    n = max(1, int(left * len(gaussians)))
    background = BACKGROUNDS[config.data.background]
    shown = unvalidated(gaussians, views, config, device)
    order = removal_order(gaussians, shown, lambda g: len(g) <= n, config.render, device, background)
    return np.sort(order[:n])


def unvalidated(gaussians: Gaussians, views: list[View], config: TrainConfig, device: "Device") -> list[View]:
    """Some photos to price Gaussians by, that show what is rendered in the blocks that validate.

    What is seen there alone has a price then, and no photo's block has a say in it.
    """
    pairs = _some(list(zip(views, split(views)[0], strict=True)))
    cameras = [whole.camera for whole, _ in pairs]
    renderings = render_views(
        gaussians, cameras, config.render, device, background=BACKGROUNDS[config.data.background]
    )
    return [
        replace(whole, image=np.where(training.mask[:, :, None], whole.image, to_uint8(rendering.rgb)))
        if training.mask is not None
        else whole
        for (whole, training), rendering in zip(pairs, renderings, strict=True)
    ]


def settle(
    search: Search,
    iteration: int,
    gaussians: Gaussians,
    views: list[View],
    config: TrainConfig,
    device: "Device",
    sh_degree: int,
) -> int:
    """The degree of the spherical harmonics that is worth most, of those that are trained; ends the search."""
    search.settled = iteration
    for degree in range(sh_degree + 1):
        seen = validate(gaussians, views, config, device, degree)
        search.degrees.append(point(iteration, len(gaussians), degree, [seen], config))
    return max(search.degrees, key=lambda p: p.worth).sh_degree


def without_useless_bands(
    gaussians: Gaussians, views: list[View], config: TrainConfig, device: "Device"
) -> Gaussians:
    """Zero, per Gaussian, the bands of the spherical harmonics without which the photos are rendered no worse.

    Each is priced alone; of many together the cheapest are taken, half as many until the photos agree.
    """
    some = _some(views)
    bands = price(gaussians, some, config.render, device, BACKGROUNDS[config.data.background]).bands
    degree = gaussians.sh_degree
    before = np.mean(validate(gaussians, some, config, device, degree))
    useless = bands[bands <= 0]
    for share in BAND_SHARES if len(useless) else ():
        fewer = without_bands(gaussians, bands - np.quantile(useless, share), 0.0)
        if np.mean(validate(fewer, some, config, device, degree)) >= before:
            return fewer
    return gaussians


def lower_degree(kept: Kept, degree: int) -> Kept:
    """Without the bands of spherical harmonics above a degree."""
    moments = Moments(with_degree(kept.moments.first, degree), with_degree(kept.moments.second, degree))
    return Kept(with_degree(kept.gaussians, degree), moments, kept.statistics)
