"""How many Gaussians a scene needs: chosen from its photos (docs/size.md).

Of the training photos some validate. A size is worth its PSNR on them less a price for each doubling of the
Gaussians, and sizes are compared in trials: two copies of the scene that differ in nothing but their size train for
the same iterations, and the one that is worth more goes on. In the first half of a run the trials are of growth,
then of Gaussians removed by price. The degree of the spherical harmonics is chosen by the same price on bytes. At the
end all photos train.
"""

import json
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import log, log2, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.densify.schedule import TRIAL_LENGTH, growth_window
from clsplat.densify.strategy import MOST_GAUSSIANS
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.metrics import psnr, to_uint8
from clsplat.optim import Moments
from clsplat.prune import price, with_degree, without_bands
from clsplat.render import render_views
from clsplat.scene import View

if TYPE_CHECKING:
    from clsplat.device import Device

VALIDATING = 12
"""Training photos, evenly spaced, of which parts validate while the size is sought. Whole photos in their place were
missed: with every eighth held back for three quarters of a run fox_pinhole ended 0.2 dB lower."""

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
"""Fraction by which they end: all photos train for the rest."""

GROWTH_START = 500
"""Iterations before the first trial of growth, fewer in short runs, as before the strategies' first rounds."""

SURE = 3.0
"""Standard errors."""

LOST_GROWTH = 2
"""After so many trials in turn that the smaller side has won, growth has ended."""

LOOKS = 2
"""Validations of each side of a trial, averaged: PSNR goes up and down while the learning rates are high. From single
looks at five photos of fox_pinhole the differences of sides had standard errors of 0.1 to 0.4 dB."""

TRIAL = sqrt(0.5)
"""Fraction of the Gaussians that a trial leaves: two are a halving."""


class Point(NamedTuple):
    """A size that was validated.

    iteration: before which; n Gaussians of a degree of the spherical harmonics; psnr: dB, the mean over the
    validation photos; views: of each. worth: psnr less the price.
    """

    iteration: int
    n: int
    sh_degree: int
    psnr: float
    views: list[float]
    worth: float


class Trial(NamedTuple):
    """Two sizes after the same iterations from the same scene, of which either the larger has grown or the smaller
    has been pruned."""

    grows: bool
    smaller: Point
    larger: Point

    @property
    def takes_smaller(self) -> bool:
        """Whether the smaller goes on: pruned, if it is worth more by a standard error; against growth, which pays
        late, only if the larger is worse by more than chance."""
        error = standard_error(self.larger, self.smaller)
        if self.grows:
            return self.larger.n == self.smaller.n or self.smaller.psnr - self.larger.psnr > SURE * error
        return self.smaller.worth - error >= self.larger.worth


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
    return len(views) >= FEWEST_PHOTOS


BAND_SHARES = (1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)
"""Of the bands that seem useless one by one. All of them together cost fox_pinhole 0.2 dB (135x240, 7000
iterations)."""

RANDOM_START = 10_000
"""Gaussians of a random start: fog, which the photos dissolve before it grows to what they show."""

PRICING = 24
"""Photos, at most, by which Gaussians are priced."""


def sh_bytes(sh_degree: int) -> int:
    """Bytes of a Gaussian with spherical harmonics of a degree, in single precision."""
    return 4 * (11 + 3 * (sh_degree + 1) ** 2)


def stops(config: TrainConfig) -> list[int]:
    """The iterations before which trials begin or end: of growth, and from `first_shrink` on of pruning."""
    first, length = first_shrink(config), max(1, round(TRIAL_LENGTH * config.iterations))
    shrinks = range(first, max(first, round(PRUNING_END * config.iterations)) + 1, length)
    earliest, window = config.shortened(GROWTH_START), growth_window(config)
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
    """PSNR of each view, in dB, of renders rounded to 8 bits."""
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
    return [psnr(to_uint8(r.rgb), view.image, view.mask) for r, view in zip(renderings, views, strict=True)]


def point(iteration: int, n: int, sh_degree: int, seen: list[list[float]], config: TrainConfig) -> Point:
    """What a size is worth by the PSNR of each photo at each look."""
    views = [float(view) for view in np.mean(seen, axis=0)]
    mean = float(np.mean(views))
    return Point(iteration, n, sh_degree, mean, views, mean - config.size_price * log2(n * sh_bytes(sh_degree)))


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
        lost = [trial.takes_smaller for trial in grown[-LOST_GROWTH:]]
        ended = (len(lost) == LOST_GROWTH and all(lost)) or iteration >= round(GROWTH_END * config.iterations)
        if ended or search.most >= most:
            return "rest"
        return "try" if search.most >= surely_short(grown, config.size_price) else "grow"
    shrunk = [trial for trial in search.trials if not trial.grows]
    if iteration == stops(config)[-1] or (shrunk and not shrunk[-1].takes_smaller):
        return "settle"
    return "shrink"


def surely_short(grown: list[Trial], price: float) -> float:
    """A number of Gaussians below which growth needs no trial, by what the last one gained.

    Gains per doubling fall by about half from doubling to doubling (docs/size.md): what gains g reaches the price
    p after log2(g / p) doublings. Growth is free for half of them.
    """
    if not grown:
        return 0
    smaller, larger = grown[-1].smaller, grown[-1].larger
    if larger.psnr <= smaller.psnr:
        return 0
    gain = (larger.psnr - smaller.psnr) / log2(larger.n / smaller.n)
    return larger.n * sqrt(gain / price) if gain > price else 0


def costliest_rows(
    gaussians: Gaussians, views: list[View], config: TrainConfig, device: "Device"
) -> NDArray[np.intp]:
    """The rows that a trial leaves, in their order: those whose removal costs most.

    In the order of `clsplat.prune.removal_order`, but priced once: its rounds took as long as the refit.
    """
    some = views[:: -(-len(views) // PRICING)]
    prices = price(gaussians, some, config.render, device, BACKGROUNDS[config.data.background], bands=False)
    left = max(1, int(TRIAL * len(gaussians)))
    return np.sort(np.argsort(-prices.costs, kind="stable")[:left])


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
    some = views[:: -(-len(views) // PRICING)]
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


def write_report(path: Path, search: Search, config: TrainConfig) -> None:
    """size.json: every point with what it was worth, the rule and the choice.

    least_share: the price as that of one Gaussian. A doubling that gains p dB lowers the squared error by the
    fraction p ln(10)/10, and is ln(2) on the natural scale of N: the last Gaussian must lower it by this part of a
    Gaussian's even share.
    """
    chosen = max(search.degrees, key=lambda p: p.worth)
    content = {
        "rule": "growth unless it loses more than twice the standard error; pruning if worth = psnr - price "
        "log2(bytes) is as large; then the degree with the largest worth",
        "price": config.size_price,
        "least_share": config.size_price * log(10) / (10 * log(2)),
        "chosen": {"n": chosen.n, "sh_degree": chosen.sh_degree},
        "trials": [
            {
                "iteration": trial.larger.iteration,
                "kind": "growth" if trial.grows else "pruning",
                "n": [trial.smaller.n, trial.larger.n],
                "psnr": [trial.smaller.psnr, trial.larger.psnr],
                "gain": trial.larger.psnr - trial.smaller.psnr,
                "standard_error": standard_error(trial.larger, trial.smaller),
                "price": config.size_price * log2(trial.larger.n / trial.smaller.n),
                "taken": trial.smaller.n if trial.takes_smaller else trial.larger.n,
            }
            for trial in search.trials
        ],
        "degrees": [
            {"sh_degree": p.sh_degree, "bytes": p.n * sh_bytes(p.sh_degree), "psnr": p.psnr, "worth": p.worth}
            for p in search.degrees
        ],
    }
    with replacing(path) as file:
        file.write(json.dumps(content, indent=1).encode())


def standard_error(a: Point, b: Point) -> float:
    """Of the difference of two points' PSNR: photo by photo, since photos differ more than sizes do."""
    differences = np.array(a.views) - np.array(b.views)
    return float(differences.std(ddof=1) / sqrt(len(differences)))


def size_chart(report: Path, path: Path) -> None:
    """Draw how the size of a scene was chosen, as a PNG.

    Left, the validation PSNR against the number of Gaussians: the two sides of each trial joined; right, against the
    bytes, of each degree of the spherical harmonics.

    Parameters
    ----------
    report : Path
        size.json of a training run.
    path : Path
        The PNG.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    content = json.loads(report.read_text())
    chosen, degrees = content["chosen"], content["degrees"]
    figure = Figure(figsize=(9, 4.2), dpi=150, layout="constrained")
    by_n, by_bytes = figure.subplots(1, 2, width_ratios=[3, 2])
    grey, blue, orange, green = "0.55", "#0072b2", "#d55e00", "#009e73"
    labelled: set[str] = set()
    for trial in content["trials"]:
        color, label = (grey, "growth") if trial["kind"] == "growth" else (blue, "pruning")
        by_n.plot(trial["n"], trial["psnr"], "-", color=color, label=None if label in labelled else label)
        labelled.add(label)
        for n, quality in zip(trial["n"], trial["psnr"], strict=True):
            by_n.plot(n, quality, "o", color=color, markerfacecolor=color if n == trial["taken"] else "white")
        price = [trial["psnr"][0], trial["psnr"][0] + trial["price"]]
        name = f"price: {content['price']:g} dB per doubling"
        by_n.plot(trial["n"], price, "--", color=orange, linewidth=1, label=None if name in labelled else name)
        labelled.add(name)
    best = max(degrees, key=lambda p: p["worth"])
    by_n.axvline(chosen["n"], color=orange, linewidth=0.8, label=f"chosen: {chosen['n']:,}")
    by_n.set_xlabel("Gaussians; two sides of a trial joined, the full one goes on")
    by_n.set_ylabel("PSNR of the validation photos, dB")
    by_bytes.plot([p["bytes"] / 1e6 for p in degrees], [p["psnr"] for p in degrees], "o-", color=green)
    by_bytes.plot(best["bytes"] / 1e6, best["psnr"], "*", color=orange, markersize=15, zorder=4)
    for p in degrees:
        marker = ", chosen" if p is best else ""
        by_bytes.annotate(
            f"degree {p['sh_degree']}{marker}", (p["bytes"] / 1e6, p["psnr"]), (4, -11), textcoords="offset points"
        )
    by_bytes.set_xlabel("MB, without refitting")
    by_bytes.margins(x=0.3)
    for axes in (by_n, by_bytes):
        axes.set_xscale("log", base=2)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.3g}" if x < 1000 else f"{x / 1000:,.3g}k"))
        axes.grid(color="0.9")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    by_n.legend(frameon=False)
    with replacing(path) as file:
        figure.savefig(file, format="png", metadata={"Software": None})
