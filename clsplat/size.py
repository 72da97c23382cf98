"""How many Gaussians a scene needs: chosen from its photos (docs/size.md).

Of the training photos some validate. A size is worth its PSNR on them less a price for each doubling of the
Gaussians, and the size that is worth most is chosen: growth stops when a doubling gains less than the price, then a
path of pruning by removal price and refitting leads down in steps, and the best step is kept. The degree of the
spherical harmonics is chosen by the same price on bytes. At the end all photos train.
"""

import json
from dataclasses import dataclass, field
from math import log, log2, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config import BACKGROUNDS, TrainConfig
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
"""With fewer photos to validate on, a difference of PSNR has no error that can be told: the size is not sought."""

PATH_START = 0.55
"""Fraction of the iterations at which the path down begins: growth of the default strategy ends at 0.5, and what it
added has settled."""

PATH_END = 0.9
"""Fraction by which it ends: all photos train for the rest."""

STEP_LENGTH = 0.05
"""Iterations of a step of the path, as a fraction of all. On photos of 64 known Gaussians (tests/test_size.py) steps
of 0.03 of 1500 iterations refitted too little: every one lost 0.1 to 0.4 dB, and 512 Gaussians were kept."""

STEP = sqrt(0.5)
"""Fraction of the Gaussians that a step leaves: two steps are a halving."""


class Point(NamedTuple):
    """A size that was validated.

    iteration; phase: growth, path or degree; n Gaussians of a degree of the spherical harmonics; psnr: dB, the mean
    over the validation photos; views: of each. worth: psnr less the price, for a degree on bytes.
    """

    iteration: int
    phase: str
    n: int
    sh_degree: int
    psnr: float
    views: list[float]
    worth: float


class Kept(NamedTuple):
    """What training goes back to: rows of one size, on the host."""

    gaussians: Gaussians
    moments: Moments
    statistics: dict[str, NDArray[Any]]

    def take(self, rows: NDArray[Any]) -> "Kept":
        """Some of the rows."""
        statistics = {name: array[rows] for name, array in self.statistics.items()}
        return Kept(self.gaussians.take(rows), self.moments.take(rows, np.zeros(len(rows), bool)), statistics)


@dataclass
class Search:
    """The state of the search: the points so far, whether growth has ended, the iteration after which the size was
    settled (0: it is still sought), and the best of the path."""

    points: list[Point] = field(default_factory=list)
    grown: bool = False
    settled: int = 0
    best: Kept | None = None


def split(views: list[View]) -> tuple[list[View], list[View]]:
    """Photos to train on and to validate on."""
    chosen = range(VALIDATES // 2, len(views), VALIDATES)
    return [v for i, v in enumerate(views) if i not in chosen], [views[i] for i in chosen]


def can_search(views: list[View]) -> bool:
    """Whether there are photos enough."""
    return len(split(views)[1]) >= FEWEST_VALIDATING


def sh_bytes(sh_degree: int) -> int:
    """Bytes of a Gaussian with spherical harmonics of a degree, in single precision."""
    return 4 * (11 + 3 * (sh_degree + 1) ** 2)


def stops(config: TrainConfig) -> list[int]:
    """The iterations after which the path is visited."""
    first, last = round(PATH_START * config.iterations), round(PATH_END * config.iterations)
    return list(range(max(1, first), max(1, last) + 1, max(1, round(STEP_LENGTH * config.iterations))))


def progress(iteration: int, config: TrainConfig, search: Search | None) -> float:
    """Where an iteration stands in the schedule of the learning rates, from 0 to 1.

    On the path it stands still: every size is refitted under the same conditions, and what the photos gain by smaller
    steps alone favours none. Once the size is settled the rest of the schedule follows.
    """
    last = max(config.iterations - 1, 1)
    if search is None:
        return (iteration - 1) / last
    start = (stops(config)[0] - 1) / last
    if not search.settled:
        return min((iteration - 1) / last, start)
    return start + (1 - start) * (iteration - search.settled) / max(config.iterations - search.settled, 1)


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


def point(
    iteration: int, phase: str, gaussians: Gaussians, views: list[float], sh_degree: int, config: TrainConfig
) -> Point:
    """The point of a validation, and what it is worth."""
    n, mean = len(gaussians), float(np.mean(views))
    doublings = log2(n) if phase != "degree" else log2(sh_bytes(sh_degree))
    return Point(iteration, phase, n, sh_degree, mean, views, mean - config.size_price * doublings)


def growth_pays(points: list[Point], price_db: float) -> bool:
    """Whether the last doubling of the Gaussians, if there was one, gained the price.

    The best PSNR until now is compared with the best until there were half as many: what training itself gained
    in the meantime counts too, so growth never stops too early, and a reset of the opacities does not stop it.
    """
    growth = [p for p in points if p.phase == "growth"]
    half = [p for p in growth if p.n <= growth[-1].n / 2] if growth else []
    if not half:
        return True
    return max(p.psnr for p in growth) - max(p.psnr for p in half) >= price_db * log2(growth[-1].n / half[-1].n)


def path_ends(points: list[Point], price_db: float) -> bool:
    """Whether the path has lost a whole price from its best point."""
    path = [p.worth for p in points if p.phase == "path"]
    return path[-1] < max(path) - price_db


def costliest_rows(
    gaussians: Gaussians, views: list[View], config: TrainConfig, device: "Device"
) -> NDArray[np.intp]:
    """The rows that a step of the path leaves, in their order: those whose removal costs most.

    In the order of `clsplat.prune.removal_order`, but priced once: its rounds took as long as the refit.
    """
    prices = price(gaussians, views, config.render, device, BACKGROUNDS[config.data.background])
    left = max(1, int(STEP * len(gaussians)))
    return np.sort(np.argsort(-prices.costs, kind="stable")[:left])


def settle(search: Search, views: list[View], config: TrainConfig, device: "Device") -> Kept:
    """The best of the path with the degree of the spherical harmonics that is worth most; ends the search."""
    assert search.best is not None, "the path has no point"
    best, search.best, search.settled = search.best, None, search.points[-1].iteration
    from_path = max((p for p in search.points if p.phase == "path"), key=lambda p: p.worth)
    points = [
        point(from_path.iteration, "degree", best.gaussians, scores, degree, config)
        for degree in range(from_path.sh_degree + 1)
        for scores in [validate(best.gaussians, views, config, device, degree)]
    ]
    search.points += points
    return lower_degree(best, max(points, key=lambda p: p.worth).sh_degree)


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
    chosen = [
        max((p for p in search.points if p.phase == phase), key=lambda p: p.worth) for phase in ("path", "degree")
    ]
    content = {
        "rule": "the point of the path with the largest worth = psnr - price log2(n), then the degree with the "
        "largest psnr - price log2(bytes per Gaussian)",
        "price": config.size_price,
        "least_share": config.size_price * log(10) / (10 * log(2)),
        "chosen": {"n": chosen[0].n, "sh_degree": chosen[1].sh_degree},
        "points": [
            {**p._asdict(), "bytes": p.n * sh_bytes(p.sh_degree), "standard_error": standard_error(p, chosen[0])}
            for p in search.points
        ],
    }
    with replacing(path) as file:
        file.write(json.dumps(content, indent=1).encode())


def standard_error(a: Point, b: Point) -> float:
    """Of the difference of two points' PSNR: photo by photo, since photos differ more than sizes do."""
    differences = np.array(a.views) - np.array(b.views)
    return float(differences.std(ddof=1) / sqrt(len(differences)))


def size_chart(report: Path, path: Path) -> None:
    """Draw how the size of a scene was chosen, as a PNG: validation PSNR against the number of Gaussians and bytes.

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
    points, chosen = content["points"], content["chosen"]
    figure = Figure(figsize=(9, 4.2), dpi=150, layout="constrained")
    by_n, by_bytes = figure.subplots(1, 2, sharey=True, width_ratios=[3, 2])
    growth, down, degrees = ([p for p in points if p["phase"] == phase] for phase in ("growth", "path", "degree"))
    blue, orange, green = "#0072b2", "#d55e00", "#009e73"
    by_n.plot([p["n"] for p in growth], [p["psnr"] for p in growth], ".-", color="0.7", label="growing")
    errors = [p["standard_error"] for p in down]
    by_n.errorbar(
        [p["n"] for p in down],
        [p["psnr"] for p in down],
        errors,
        fmt="o-",
        color=blue,
        capsize=3,
        label="pruned, refitted",
    )
    best = max(down, key=lambda p: p["worth"])
    width = np.array([best["n"] / 3, best["n"] * 3])
    tangent = best["psnr"] + content["price"] * np.log2(width / best["n"])
    by_n.plot(width, tangent, "--", color=orange, linewidth=1, label=f"price: {content['price']:g} dB per doubling")
    by_n.plot(best["n"], best["psnr"], "*", color=orange, markersize=15, label=f"chosen: {best['n']:,}")
    by_n.set_xlabel("Gaussians")
    by_n.set_ylabel("PSNR of the validation photos, dB")
    by_bytes.plot([p["bytes"] / 1e6 for p in degrees], [p["psnr"] for p in degrees], "o-", color=green)
    for p in degrees:
        marker = ", chosen" if p["sh_degree"] == chosen["sh_degree"] else ""
        by_bytes.annotate(
            f"degree {p['sh_degree']}{marker}", (p["bytes"] / 1e6, p["psnr"]), (4, -11), textcoords="offset points"
        )
    by_bytes.set_xlabel("MB, without refitting")
    # Growth begins far below: its first points are not what the choice is about.
    lowest = min(p["psnr"] for p in down + degrees)
    by_n.set_ylim(bottom=lowest - 1)
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
