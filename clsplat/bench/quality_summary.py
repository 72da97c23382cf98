"""Summaries of the results of `clsplat bench quality`: trainings, means over scenes, Pareto fronts and tables."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from clsplat.bench.results import KEYS, Record

MEAN = "mean/"
"""Name of the panel with the means over scenes; no folder has this name."""


@dataclass(frozen=True)
class Quantity:
    """A column of the results: its name, its unit, the format of its values, and whether less is better."""

    name: str
    unit: str
    text: Callable[[float], str]
    less_is_better: bool = True

    def written(self, value: float | None) -> str:
        """Text of a value with its unit."""
        return "" if value is None else f"{self.text(value)} {self.unit}".strip()


def short(value: float) -> str:
    """Text of a number with at most three digits: 840, 13.6k, 1.2M."""
    for factor, suffix in ((1e6, "M"), (1e3, "k")):
        if value >= 0.9995 * factor:
            return f"{value / factor:.3g}{suffix}"
    return f"{value:.3g}"


def exact(value: int) -> str:
    """Text of a number with all of its digits: 840, 13.589k, 1.2M."""
    for factor, suffix in ((1e6, "M"), (1e3, "k")):
        if value >= factor:
            return f"{value / factor:.15g}{suffix}"
    return str(value)


def _megabytes(value: float) -> str:
    return f"{value / 1e6:.3g}" if value < 999.5e6 else f"{value / 1e6:.0f}"


def _two_digits(value: float) -> str:
    return f"{value:.2g}" if value < 9.95 else f"{value:.0f}"


METRICS = {
    "psnr": Quantity("PSNR", "dB", lambda v: f"{v:.2f}", less_is_better=False),
    "ssim": Quantity("SSIM", "", lambda v: f"{v:.3f}", less_is_better=False),
    "flip": Quantity("FLIP", "", lambda v: f"{v:.3f}"),
}
"""Measures of quality."""

COSTS = {
    "seconds": Quantity("training time", "s", _two_digits),
    "cpu_seconds": Quantity("processor time", "s", _two_digits),
    "num_gaussians": Quantity("Gaussians", "", lambda v: short(round(v))),
    "spz_bytes": Quantity("model file", "MB", _megabytes),
    "memory_bytes": Quantity("device memory", "MB", _megabytes),
    "fps": Quantity("rendering speed", "frames/s", _two_digits, less_is_better=False),
}
"""Costs that quality is charted against."""

TIMES = ("seconds", "cpu_seconds")
"""Costs that grow during a training. Each sample has its own value."""


@dataclass(frozen=True)
class Run:
    """A finished training, or the mean of several, whose `seed` is None.

    `samples` are in the order of their iterations; the last one is its end.
    """

    scene: str
    method: str
    max_gaussians: int | None
    iterations: int
    samples: tuple[Record, ...]
    seed: int | None = None

    @property
    def setting(self) -> str:
        """Method, cap, and number of iterations if it is not chosen by the photos; no other setting has this text."""
        cap = "" if self.max_gaussians is None else f" · ≤{exact(self.max_gaussians)}"
        return f"{self.method}{cap} · {exact(self.iterations)} it" if self.iterations else self.method + cap

    @property
    def last(self) -> Record:
        """The sample at the end of the training."""
        return self.samples[-1]


def runs(records: Iterable[Record]) -> list[Run]:
    """Mean over the seeds of each setting on each scene, sample by sample, from its finished trainings."""
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in trainings(records):
        groups.setdefault((run.scene, run.setting), []).append(run)
    return [
        group[0] if len(group) == 1 else replace(group[0], samples=_mean_samples(group), seed=None)
        for group in groups.values()
    ]


def trainings(records: Iterable[Record]) -> list[Run]:
    """Finished trainings, in the order of the records. With several devices, names of methods include the device."""
    records = [record for record in records if "iteration" in record]
    several = len({record["device"] for record in records}) > 1
    groups: dict[tuple[Any, ...], list[Record]] = {}
    for record in records:
        groups.setdefault(tuple(record[name] for name in KEYS), []).append(record)
    return [
        Run(
            scene=of_key[0]["scene"],
            method=of_key[0]["method"] + (f" ({of_key[0]['device']})" if several else ""),
            max_gaussians=of_key[0]["max_gaussians"],
            iterations=of_key[0]["iterations"],
            samples=tuple(sorted(of_key, key=lambda record: int(record["iteration"]))),
            seed=of_key[0]["seed"],
        )
        for of_key in groups.values()
        if any("fps" in record for record in of_key)
    ]


def failures(records: Iterable[Record]) -> list[tuple[str, str]]:
    """Setting of each failed training, and the reason."""
    return [
        (f"{r['scene']}, {Run('', r['method'], r['max_gaussians'], r['iterations'], ()).setting}", r["failed"])
        for r in records
        if "failed" in r
    ]


def scene_names(finished: Iterable[Run]) -> list[str]:
    """Scenes in the order of the runs."""
    return list(dict.fromkeys(run.scene for run in finished))


def titles(scenes: Collection[str]) -> dict[str, str]:
    """Titles of scenes: their names without the options, which stay where scenes differ only by these."""
    short_names = [scene.split(":")[0].rstrip("/") for scene in scenes]
    return {s: s if short_names.count(name) > 1 else name for s, name in zip(scenes, short_names, strict=True)}


def panels(finished: list[Run]) -> dict[str, list[Run]]:
    """Trainings by panel: with several scenes the means over them, then each scene."""
    scenes = scene_names(finished)
    by_scene = {scene: [run for run in finished if run.scene == scene] for scene in scenes}
    return by_scene if len(scenes) < 2 else {MEAN: means(finished), **by_scene}


def means(finished: list[Run]) -> list[Run]:
    """Mean over scenes of each setting that finished on all of them, sample by sample.

    It is the arithmetic mean, except for the rate of frames, whose harmonic mean is taken: the mean time of a frame.
    """
    scenes = scene_names(finished)
    settings: dict[str, list[Run]] = {}
    for run in finished:
        settings.setdefault(run.setting, []).append(run)
    return [
        Run(MEAN, group[0].method, group[0].max_gaussians, group[0].iterations, _mean_samples(group))
        for group in settings.values()
        if len(group) == len(scenes)
    ]


def _mean_samples(group: list[Run]) -> tuple[Record, ...]:
    def mean(name: str, at: tuple[Record, ...]) -> float | None:
        values = [sample[name] for sample in at if sample.get(name) is not None]
        if len(values) < len(at):
            return None
        return float(1 / np.mean(1 / np.array(values))) if name == "fps" else float(np.mean(values))

    names = ["iteration", "ply_bytes", *COSTS, *METRICS]
    return tuple({name: mean(name, at) for name in names} for at in zip(*(r.samples for r in group), strict=True))


def front(points: list[tuple[float, float]]) -> list[int]:
    """Indices of the points on the Pareto front, sorted by their first coordinate.

    Parameters
    ----------
    points : list of (cost, loss)
        Less of both is better. A point dominates another if it is not worse in both and better in at least one.
    """
    order = sorted(range(len(points)), key=lambda i: points[i])
    kept: list[int] = []
    for i in order:
        if not kept or points[i][1] < points[kept[-1]][1] or points[i] == points[kept[-1]]:
            kept.append(i)
    return kept


def coordinates(sample: Record, cost: str, metric: str) -> tuple[float, float] | None:
    """A sample as a point for `front`; None if the cost or the metric was not measured."""
    x, y = sample.get(cost), sample.get(metric)
    if x is None or y is None:
        return None
    return (x if COSTS[cost].less_is_better else -x), (y if METRICS[metric].less_is_better else -y)


def best_settings(of_panel: list[Run], cost: str, metric: str) -> list[Run]:
    """Runs whose end is on the Pareto front, the cheapest first."""
    placed = [(run, point) for run in of_panel if (point := coordinates(run.last, cost, metric)) is not None]
    return [placed[i][0] for i in front([point for _, point in placed])]


def measured_metrics(finished: Iterable[Run]) -> list[str]:
    """Metrics that at least one run has."""
    return [name for name in METRICS if any(run.last.get(name) is not None for run in finished)]


def table(finished: list[Run], cost: str) -> list[list[str]]:
    """Table with a row per setting and a column per panel: cost and metrics. The first row is the header."""
    metrics = measured_metrics(finished)
    columns = panels(finished)
    settings = list(dict.fromkeys(run.setting for run in finished))
    head = f"{COSTS[cost].name}: {', '.join(METRICS[name].name for name in metrics)}"
    rows = [[head, *titles(columns).values()]]
    for setting in settings:
        row = [setting]
        for of_panel in columns.values():
            found = next((run.last for run in of_panel if run.setting == setting), None)
            if found is None:
                row.append("")
                continue
            figures = " / ".join(METRICS[name].text(found[name]) for name in metrics if found[name] is not None)
            row.append(f"{COSTS[cost].written(found.get(cost))}: {figures}")
        rows.append(row)
    return rows


def verdict(finished: list[Run], cost: str, metric: str) -> list[str]:
    """Sentences that name the settings on the Pareto front, one per panel."""
    quantity, goal = COSTS[cost], METRICS[metric].name
    sentences, columns = [], panels(finished)
    names_of = titles(columns)
    for panel, of_panel in columns.items():
        best = best_settings(of_panel, cost, metric)
        if not best:
            continue
        names = ", ".join(run.setting for run in best)
        # What was not measured, such as the Gaussians of a radiance field, is not compared.
        placed = [run for run in of_panel if coordinates(run.last, cost, metric) is not None]
        beaten = [run.setting for run in placed if run not in best]
        where = "Mean over scenes" if panel == MEAN else names_of[panel]
        others = f"; dominated: {', '.join(beaten)}" if beaten else "; none is dominated"
        sentences.append(f"{where}, on the Pareto front of {quantity.name} and {goal}: {names}{others}.")
    return sentences


def origins(records: Iterable[Record]) -> list[str]:
    """Lines that name each device, driver and commit of the measurements, with their dates and load."""
    groups: dict[tuple[Any, ...], list[Record]] = {}
    for record in records:
        names = ("device", "compute_units", "driver", "version", "commit")
        groups.setdefault(tuple(record[name] for name in names), []).append(record)
    lines = []
    for (device, units, driver, version, commit), of_key in groups.items():
        dates = sorted(record["date"][:10] for record in of_key)
        when = dates[0] if dates[0] == dates[-1] else f"{dates[0]} to {dates[-1]}"
        loads = [record["load"] for record in of_key if record["load"] is not None]
        busy = f", load average of the machine before it {max(loads):.1f}" if loads else ""
        if loads and max(loads) > units:
            busy += ": it was busy with other work, so the times are not valid"
        lines.append(
            f"{device}, {units} compute units, driver {driver}; clsplat {version}, commit {commit or 'unknown'}; "
            f"{when}{busy}"
        )
    return lines
