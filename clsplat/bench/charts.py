"""Charts of `clsplat bench quality`: quality against each cost, and the published figures."""

import json
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, cos, pi, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.bench.kernel_report import COLORS
from clsplat.bench.quality_summary import (
    COSTS,
    MEAN,
    METRICS,
    TIMES,
    Quantity,
    Run,
    best_settings,
    coordinates,
    front,
    panels,
    scene_names,
    short,
    titles,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN_BELOW = {"psnr": 4.0, "ssim": 0.12, "flip": 0.08}
"""Distance from the worst final value to the end of the axis, in units of the metric. The first samples are far worse
and similar for all trainings, so they are cut off."""

INK, SOFT = "#1d1d1f", "#77777d"

PUBLISHED = Path(__file__).with_name("published.json")

Array = NDArray[Any]


@dataclass(frozen=True)
class Label:
    """A text to be placed next to a point. The point is in units of the axes."""

    x: float
    y: float
    text: str
    color: str


def method_colors(finished: list[Run]) -> dict[str, str]:
    """A colour for each method."""
    names = dict.fromkeys(run.method for run in finished)
    return {name: COLORS[i % len(COLORS)] for i, name in enumerate(names)}


def quality_chart(finished: list[Run], cost: str, metric: str) -> "Figure":
    """Draw quality against a cost: a large panel for the mean over scenes, and a panel per scene.

    A point is the end of a training. Against the time, a thin line is the course of a training, and a thick line the
    best quality that any setting of a method had reached by that time. Against other costs, lines join the caps of a
    method. A dashed line is the Pareto front of all trainings.
    """
    from matplotlib.figure import Figure

    columns = panels(finished)
    colors, names = method_colors(finished), titles(columns)
    scenes = len(scene_names(finished))
    rows = 0 if scenes < 2 else ceil(scenes / 2)
    figure = Figure(figsize=(8.6, 4.8 + 3.1 * rows), dpi=130, layout="constrained")
    grid = figure.add_gridspec(1 + rows, 2, height_ratios=[1.5, *[1] * rows])
    cells = [grid[0, :], *(grid[1 + k // 2, k % 2] for k in range(2 * rows))]
    places = [figure.add_subplot(cell) for cell in cells[: len(columns)]]
    labels = {}
    for (name, of_panel), axes in zip(columns.items(), places, strict=True):
        labels[axes] = _panel(axes, of_panel, cost, metric, colors)
        count = f"mean of {scenes} scenes" if name == MEAN else names[name]
        axes.set_title(count, fontsize=11 if axes is places[0] else 9, color=INK, loc="left", fontweight="bold")
    better = "less" if COSTS[cost].less_is_better else "more"
    figure.suptitle(
        f"{METRICS[metric].name} on held-out photos against {COSTS[cost].name} ({better} is better)\n"
        "Dashed: Pareto front; ≤: maximal number of Gaussians; it: iterations",
        fontsize=10,
        color=SOFT,
        x=0.01,
        ha="left",
    )
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes, texts in labels.items():
        place_labels(axes, texts, 9 if axes is places[0] else 7)
    return figure


def _panel(axes: "Axes", of_panel: list[Run], cost: str, metric: str, colors: dict[str, str]) -> list[Label]:
    labels, ends = [], []
    for run in of_panel:
        if coordinates(run.last, cost, metric) is None:
            continue
        color = colors[run.method]
        x, y = run.last[cost], run.last[metric]
        if cost in TIMES:
            path = [(s[cost], s[metric]) for s in run.samples if coordinates(s, cost, metric) is not None]
            axes.plot(*zip(*path, strict=True), color=color, linewidth=1, alpha=0.6, zorder=2)
            axes.plot(*zip(*path, strict=True), ".", color=color, markersize=3.5, alpha=0.6, zorder=2)
        axes.plot(x, y, "o", color=color, markersize=7, markeredgecolor="white", markeredgewidth=0.8, zorder=4)
        labels.append(Label(x, y, run.setting, color))
        ends.append((x, y))
    for method, color in colors.items():
        for line in _method_lines([run for run in of_panel if run.method == method], cost, metric):
            axes.plot(*zip(*line, strict=True), color=color, linewidth=1.8, zorder=3)
    best = [(run.last[cost], run.last[metric]) for run in best_settings(of_panel, cost, metric)]
    _dashes(axes, best, COSTS[cost].less_is_better)
    _dress(axes, COSTS[cost], METRICS[metric])
    _limits(axes, ends, SHOWN_BELOW[metric] if cost in TIMES else 0.0, METRICS[metric].less_is_better)
    return labels


def _method_lines(of_method: list[Run], cost: str, metric: str) -> list[list[tuple[float, float]]]:
    """Lines of a method: against the time, the front of all its samples; otherwise, lines through the ends by cap."""
    if len(of_method) < 2:
        return []
    if cost in TIMES:
        points = [p for run in of_method for s in run.samples if (p := coordinates(s, cost, metric)) is not None]
        sign = 1 if METRICS[metric].less_is_better else -1
        return [_steps([(points[i][0], sign * points[i][1]) for i in front(points)], post=True)]
    lines: dict[int, list[tuple[float, float]]] = {}
    for run in of_method:
        if coordinates(run.last, cost, metric) is not None:
            lines.setdefault(run.iterations, []).append((run.last[cost], run.last[metric]))
    return [sorted(line) for line in lines.values()]


def _dashes(axes: "Axes", best: list[tuple[float, float]], less_is_better: bool) -> None:
    """Draw the Pareto front as a staircase."""
    if len(best) > 1:
        steps = _steps(sorted(best), post=less_is_better)
        axes.plot(*zip(*steps, strict=True), color=INK, linewidth=1, linestyle="--", zorder=1)


def _steps(points: list[tuple[float, float]], post: bool) -> list[tuple[float, float]]:
    """Add the corners of a staircase to points. A value holds after its point (`post`) or before it."""
    path = points[:1]
    for (x0, y0), (x1, y1) in pairwise(points):
        path += [(x1, y0) if post else (x0, y1), (x1, y1)]
    return path


def _dress(axes: "Axes", x: Quantity, y: Quantity) -> None:
    """Set axes and labels. The axis of costs is logarithmic."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: x.text(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=8, colors=SOFT, which="both")
    axes.set_xlabel(f"{x.name}, {x.unit}" if x.unit else x.name, fontsize=8, color=SOFT)
    axes.set_ylabel(f"{y.name}, {y.unit}" if y.unit else y.name, fontsize=8, color=SOFT)
    axes.grid(color="0.93")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("0.8")


def _ticks(axes: "Axes") -> None:
    """Choose few enough ticks that their labels do not touch."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    left, right = axes.get_xlim()
    decades = np.log10(right / left)
    subs = (1, 2, 5) if decades < 1.5 else (1, 3) if decades < 3 else (1,)
    axes.xaxis.set_major_locator(MaxNLocator(4) if decades < 0.7 else LogLocator(subs=subs))


def _limits(axes: "Axes", ends: list[tuple[float, float]], below: float, less_is_better: bool) -> None:
    """Set limits with space for the labels around the ends, and for the lines down to `below` the worst end."""
    if not ends:
        return
    xs, ys = zip(*ends, strict=True)
    low, high = min(ys), max(ys)
    spread = max(high - low, 1e-3 * abs(high)) or 1e-3  # the FLIP of images without error is 0
    bottom, top = (high + below + 0.4 * spread, low) if less_is_better else (low - below - 0.4 * spread, high)
    axes.set_ylim(bottom, top + 0.12 * (top - bottom))
    shown = [x for line in axes.lines for x, y in np.asarray(line.get_xydata()) if (y - bottom) * (top - bottom) > 0]
    left, right = min(shown), max(xs)
    factor = max((right / left) ** 0.15, 1.2)
    axes.set_xlim(left / factor, right * factor**1.4)
    _ticks(axes)


def place_labels(axes: "Axes", labels: list[Label], size: float) -> None:
    """Place labels next to their points, without overlaps and inside the axes, and away from lines if possible.

    From top to bottom, each label takes the best of several positions around its point. A line joins a distant label
    to its point. The layout of the figure must be final.
    """
    from matplotlib.text import Text

    box = axes.get_window_extent()
    points = axes.transData.transform([(label.x, label.y) for label in labels]) if labels else np.zeros((0, 2))
    lines = np.concatenate([np.zeros((0, 2)), *(_along(axes, line.get_xydata()) for line in axes.lines)])
    unit = axes.figure.dpi / 72
    taken: list[tuple[float, float, float, float]] = [
        (x - 4 * unit, y - 4 * unit, x + 4 * unit, y + 4 * unit) for x, y in points
    ]
    for i in sorted(range(len(labels)), key=lambda i: -points[i][1]):
        text = axes.annotate(
            labels[i].text,
            (labels[i].x, labels[i].y),
            xytext=(0, 0),
            textcoords="offset points",
            fontsize=size,
            color=_readable(labels[i].color),
            ha="center",
            va="center",
            zorder=5,
            arrowprops={"arrowstyle": "-", "color": labels[i].color, "linewidth": 0.6, "shrinkA": 1, "shrinkB": 3},
        )
        extent = Text.get_window_extent(text)  # without the line of the annotation
        width, height = extent.width + 4 * unit, extent.height + 2 * unit

        def cost(offset: tuple[float, float]) -> float:
            x, y = points[i] + offset  # noqa: B023
            here = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)  # noqa: B023
            area = width * height  # noqa: B023
            over = sum(_overlap(here, other) for other in taken) / area
            outside = 1 - _overlap(here, (box.x0, box.y0, box.x1, box.y1)) / area
            inside = (lines[:, 0] > here[0]) & (lines[:, 0] < here[2])
            inside &= (lines[:, 1] > here[1]) & (lines[:, 1] < here[3])
            return 100 * over + 100 * outside + 0.25 * inside.sum() + np.hypot(*offset) / (20 * unit)

        offsets = [
            ((r * unit + width / 2) * cos(a), (r * unit + height / 2) * sin(a))
            for r in (5, 12, 22, 36, 54, 76)
            for a in np.arange(0, 2 * pi, pi / 8)
        ]
        dx, dy = min(offsets, key=cost)
        text.set_position((dx / unit, dy / unit))
        x, y = points[i] + (dx, dy)
        taken.append((x - width / 2, y - height / 2, x + width / 2, y + height / 2))


def _along(axes: "Axes", path: Any) -> Array:
    """Points on a line, px, closer to each other than the height of a letter."""
    corners = axes.transData.transform(np.asarray(path, dtype=float))
    parts = [np.linspace(a, b, 1 + int(np.hypot(*(b - a)) / 4)) for a, b in pairwise(corners)]
    return np.concatenate([corners, *parts])


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


def _readable(color: str) -> Any:
    """A darker version of a colour, for text."""
    from matplotlib.colors import to_rgb

    return tuple(0.72 * channel for channel in to_rgb(color))


def read_published() -> dict[str, Any]:
    """Read the tables of the original paper: a dictionary of columns for each dataset and method."""
    data: dict[str, Any] = json.loads(PUBLISHED.read_text(encoding="utf-8"))
    data["datasets"] = {
        dataset: {name: dict(zip(data["columns"], values, strict=True)) for name, values in methods.items()}
        for dataset, methods in data["datasets"].items()
    }
    return data


def published_chart(metric: str) -> "Figure":
    """Draw the published figures: quality against training time, one panel per dataset."""
    from matplotlib.figure import Figure

    data = read_published()
    figure = Figure(figsize=(8.6, 9.6), dpi=130, layout="constrained")
    time = Quantity("training time", "s", short)
    labels: dict[Axes, list[Label]] = {}
    for axes, (dataset, methods) in zip(
        figure.subplots(len(data["datasets"]), 1), data["datasets"].items(), strict=True
    ):
        labels[axes] = []
        for i, (name, row) in enumerate(methods.items()):
            x, y = row["train_seconds"], row[metric]
            axes.plot(x, y, "s", color=COLORS[i], markersize=6, zorder=4)
            labels[axes].append(Label(x, y, name, COLORS[i]))
        ends = [(label.x, label.y) for label in labels[axes]]
        _dashes(axes, [ends[i] for i in front([(x, -y) for x, y in ends])], less_is_better=True)
        _dress(axes, time, METRICS[metric])
        ys = [y for _, y in ends]
        spread = max(ys) - min(ys)
        axes.set_xlim(100, 1e6)
        axes.set_ylim(min(ys) - 0.15 * spread, max(ys) + 0.2 * spread)
        _ticks(axes)
        axes.set_title(dataset, fontsize=10, color=INK, loc="left", fontweight="bold")
    figure.suptitle(
        f"Published: Kerbl et al. 2023, table 1. Other scenes, other hardware ({data['device']}):\n"
        "compare methods within a panel, not with the other charts",
        fontsize=10,
        color=SOFT,
        x=0.01,
        ha="left",
    )
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes, texts in labels.items():
        place_labels(axes, texts, 8)
    return figure


def published_table() -> list[list[str]]:
    """Table of the published figures: a row per method, a column per dataset. The first row is the header."""
    data = read_published()
    rows = [["SSIM / PSNR / LPIPS; training, frames/s, memory", *data["datasets"]]]
    for name in next(iter(data["datasets"].values())):
        row = [name]
        for methods in data["datasets"].values():
            v = methods[name]
            row.append(
                f"{v['ssim']:.3f} / {v['psnr']:.2f} / {v['lpips']:.3f}; {_duration(v['train_seconds'])}, "
                f"{v['fps']:g}, {v['memory_mb']:g} MB"
            )
        rows.append(row)
    return rows


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:.0f} h" if seconds >= 7200 else f"{seconds / 60:.0f} min"
