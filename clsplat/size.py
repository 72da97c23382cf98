"""How many Gaussians a scene needs: chosen from its photos (docs/size.md).

Of the training photos some validate. A size is worth its PSNR on them less a price for each doubling of the
Gaussians, and sizes are compared in trials: two copies of the scene that differ in nothing but their size train for
the same iterations, and the one that is worth more goes on. In the first half of a run the trials are of growth,
then of Gaussians removed by price. The degree of the spherical harmonics is chosen by the same price on bytes. At the
end all photos train.
"""

import json
from dataclasses import dataclass, field
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

VALIDATES = 8
"""Every 8th training photo validates while the size is sought."""

FEWEST_VALIDATING = 2
"""At least so many do: the difference of PSNR of a single photo has no error that can be told."""

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

REWARMED = 0.5
"""Where the schedule of the learning rates goes on once the size is settled, so that the validation photos, which
join, can still move something."""

GROWTH_START = 500
"""Iterations before the first trial of growth, fewer in short runs, as before the strategies' first rounds."""

SURE = 2.0
"""Standard errors."""

LOST_GROWTH = 2
"""After so many trials in turn that the smaller side has won, growth has ended."""

LOOKS = 4
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
        """Whether the smaller goes on: pruned, if it is worth as much; against growth, which pays late, only if the
        larger is worse by more than chance."""
        if self.grows:
            lost = self.smaller.psnr - self.larger.psnr
            return self.larger.n == self.smaller.n or lost > SURE * standard_error(self.larger, self.smaller)
        return self.smaller.worth >= self.larger.worth


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
    """Photos to train on and to validate on."""
    every = max(1, min(VALIDATES, len(views) // FEWEST_VALIDATING))
    chosen = range(every // 2, len(views), every)
    return [v for i, v in enumerate(views) if i not in chosen], [views[i] for i in chosen]


def can_search(views: list[View]) -> bool:
    """Whether there are photos enough."""
    return len(views) >= FEWEST_PHOTOS


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


def progress(iteration: int, config: TrainConfig, search: Search | None) -> float:
    """Where an iteration stands in the schedule of the learning rates, from 0 to 1.

    Where the size is sought it has ended when pruning begins, and its end follows again once the size is settled.
    """
    if search is None:
        return (iteration - 1) / max(config.iterations - 1, 1)
    if not search.settled:
        return min(1, (iteration - 1) / max(first_shrink(config) - 1, 1))
    return REWARMED + (1 - REWARMED) * (iteration - search.settled) / max(config.iterations - search.settled, 1)


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


def next_trial(search: Search, iteration: int, config: TrainConfig) -> Literal["grow", "rest", "shrink", "settle"]:
    """What follows at one of the `stops`."""
    if iteration < first_shrink(config):
        lost = [trial.takes_smaller for trial in search.trials[-LOST_GROWTH:]]
        ended = (len(lost) == LOST_GROWTH and all(lost)) or iteration >= round(GROWTH_END * config.iterations)
        return "rest" if ended or search.most >= (config.max_gaussians or MOST_GAUSSIANS) else "grow"
    shrunk = [trial for trial in search.trials if not trial.grows]
    if iteration == stops(config)[-1] or (shrunk and not shrunk[-1].takes_smaller):
        return "settle"
    return "shrink"


def costliest_rows(
    gaussians: Gaussians, views: list[View], config: TrainConfig, device: "Device"
) -> NDArray[np.intp]:
    """The rows that a trial leaves, in their order: those whose removal costs most.

    In the order of `clsplat.prune.removal_order`, but priced once: its rounds took as long as the refit.
    """
    prices = price(gaussians, views, config.render, device, BACKGROUNDS[config.data.background])
    left = max(1, int(TRIAL * len(gaussians)))
    return np.sort(np.argsort(-prices.costs, kind="stable")[:left])


def settle(
    search: Search,
    iteration: int,
    kept: Kept,
    views: list[View],
    config: TrainConfig,
    device: "Device",
    sh_degree: int,
) -> Kept:
    """With the degree of the spherical harmonics that is worth most, of those that are trained; ends the search."""
    search.settled = iteration
    for degree in range(sh_degree + 1):
        seen = validate(kept.gaussians, views, config, device, degree)
        search.degrees.append(point(iteration, len(kept.gaussians), degree, [seen], config))
    return lower_degree(kept, max(search.degrees, key=lambda p: p.worth).sh_degree)


def training_views(views: list[View], search: Search | None) -> list[View]:
    """The photos that train: all but those that validate while the size is sought."""
    return split(views)[0] if search and not search.settled else views


def without_useless_bands(
    gaussians: Gaussians, views: list[View], config: TrainConfig, device: "Device"
) -> Gaussians:
    """Zero, per Gaussian, the bands of the spherical harmonics without which the error is no larger."""
    prices = price(gaussians, views, config.render, device, BACKGROUNDS[config.data.background])
    return without_bands(gaussians, prices.bands, 0.0)


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
