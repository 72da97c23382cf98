"""Report of `clsplat bench captures`: figures with their noise, and the method that wins on scenes left out."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from clsplat.bench.captures import FULL, KINDS
from clsplat.bench.cells import parse_source
from clsplat.bench.quality_summary import COSTS, METRICS, Quantity, Run, trainings
from clsplat.bench.results import Record

QUANTITIES = {
    **METRICS,
    "worst": Quantity("worst view", "dB", lambda v: f"{v:.2f}", less_is_better=False),
    "rare_psnr": Quantity("rare pixels", "dB", lambda v: f"{v:.2f}", less_is_better=False),
    "gap": Quantity("train − held-out", "dB", lambda v: f"{v:.2f}"),
    "drop": Quantity("end − best", "dB", lambda v: f"{v:.2f}", less_is_better=False),
    "num_gaussians": COSTS["num_gaussians"],
    "cpu_seconds": COSTS["cpu_seconds"],
}
"""Columns of the tables."""

ERRORS = 2.0
"""Number of standard errors of a difference up to which it is a tie: chance exceeds them in about one of 20 cases."""


@dataclass(frozen=True)
class Figure:
    """A mean and its standard error, which is None if no training was repeated with another seed."""

    value: float
    error: float | None

    def text(self, quantity: Quantity) -> str:
        """Text without the unit."""
        noise = "" if self.error is None else f" ± {quantity.text(self.error)}"
        return quantity.text(self.value) + noise

    def minus(self, other: "Figure") -> "Figure":
        """Difference of two figures that are independent of each other."""
        known = self.error is not None and other.error is not None
        error = math.hypot(self.error, other.error) if known else None  # type: ignore[arg-type]
        return Figure(self.value - other.value, error)

    @property
    def result(self) -> str:
        """Name of a difference from the best competitor: win, tie, loss or noise unknown."""
        if self.error is None:
            return "noise unknown"
        if abs(self.value) <= ERRORS * self.error:
            return "tie"
        return "win" if self.value > 0 else "loss"


def figures(run: Run) -> Record:
    """The columns of a training; None where something was not measured."""
    found = {name: run.last.get(name) for name in QUANTITIES}
    train, held_out, best = (run.last.get(name) for name in ("train_psnr", "psnr", "best"))
    found["gap"] = None if train is None or held_out is None else train - held_out
    found["drop"] = None if best is None or held_out is None else held_out - best
    return found


class Results:
    """Figures of all finished trainings, by capture, method and seed."""

    def __init__(self, records: Iterable[Record]) -> None:
        self._figures: dict[tuple[str, str], list[Record]] = {}
        for run in trainings(records):
            self._figures.setdefault((run.scene, run.setting), []).append(figures(run))
        self.captures = list(dict.fromkeys(capture for capture, _ in self._figures))
        self.methods = list(dict.fromkeys(method for _, method in self._figures))
        self.common = [c for c in self.captures if all(self.finished(c, method) for method in self.methods)]
        """Captures that all methods finished. Means are over these, so that they can be compared."""
        every = [found for of_key in self._figures.values() for found in of_key]
        self.quantities = {n: q for n, q in QUANTITIES.items() if any(found[n] is not None for found in every)}
        """Quantities that were measured at least once."""

    def finished(self, capture: str, method: str) -> bool:
        """Whether a method finished on a capture."""
        return (capture, method) in self._figures

    def values(self, capture: str, method: str, name: str) -> list[float]:
        """A quantity for each seed."""
        return [found[name] for found in self._figures.get((capture, method), ()) if found[name] is not None]

    def variance(self, capture: str, name: str) -> float | None:
        """Variance over seeds on a capture, the same for all methods; over all captures if it has a single seed."""
        for captures in ([capture], self.captures):
            groups = [self.values(c, method, name) for c in captures for method in self.methods]
            freedom = sum(len(values) - 1 for values in groups if values)
            if freedom:
                return float(sum(np.var(values) * len(values) for values in groups if values)) / freedom
        return None

    def mean(self, captures: Iterable[str], method: str, name: str) -> Figure | None:
        """Mean over captures on which the quantity was measured; None if there are none."""
        means, variances = [], []
        for capture in captures:
            if values := self.values(capture, method, name):
                variance = self.variance(capture, name)
                means.append(float(np.mean(values)))
                variances.append(None if variance is None else variance / len(values))
        if not means:
            return None
        known = [variance for variance in variances if variance is not None]
        error = math.sqrt(sum(known)) / len(means) if known else None
        return Figure(float(np.mean(means)), error)

    def score(self, scenes: dict[str, list[str]], method: str) -> Figure:
        """Mean PSNR over scenes, each of which is the mean over its captures."""
        parts = [part for captures in scenes.values() if (part := self.mean(captures, method, "psnr")) is not None]
        errors = [part.error for part in parts if part.error is not None]
        error = math.sqrt(sum(e**2 for e in errors)) / len(parts) if errors else None
        return Figure(float(np.mean([part.value for part in parts])), error)


def kinds(captures: Iterable[str]) -> dict[str, list[str]]:
    """Captures by kind, the standard kinds first."""
    found: dict[str, list[str]] = {kind: [] for kind in (FULL, *KINDS.values())}
    for capture in captures:
        found.setdefault(parse_source(capture).capture.kind, []).append(capture)
    return {kind: of_kind for kind, of_kind in found.items() if of_kind}


def scenes_of(captures: Iterable[str]) -> dict[str, list[str]]:
    """Captures by scene: the dataset's folder, whatever the options."""
    found: dict[str, list[str]] = {}
    for capture in captures:
        found.setdefault(parse_source(capture).path.name, []).append(capture)
    return found


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _table(head: list[str], rows: Iterable[list[str]]) -> str:
    return "\n".join([_row(head), "|---" * len(head) + "|", *map(_row, rows)])


def _columns(results: Results) -> list[str]:
    return [q.name + (f", {q.unit}" if q.unit else "") for q in results.quantities.values()]


def _cells(results: Results, captures: list[str], method: str) -> list[str]:
    found = {name: results.mean(captures, method, name) for name in results.quantities}
    return ["" if figure is None else figure.text(QUANTITIES[name]) for name, figure in found.items()]


def groups_text(results: Results) -> str:
    """Markdown: for each kind of capture a table of the methods' means."""
    parts = []
    for kind, captures in kinds(results.common).items() if results.common else ():
        rows = [[method, *_cells(results, captures, method)] for method in results.methods]
        parts += [
            f"**{kind[0].upper() + kind[1:]}**: {', '.join(captures)}",
            _table(["method", *_columns(results)], rows),
        ]
    if missing := [capture for capture in results.captures if capture not in results.common]:
        parts.append(f"Not in the means, because not all methods have finished on them: {', '.join(missing)}.")
    return "\n\n".join(parts)


def captures_text(results: Results) -> str:
    """Markdown: a table of all captures and methods."""
    rows = [
        [capture, method, *_cells(results, [capture], method)]
        for capture in results.captures
        for method in results.methods
        if results.finished(capture, method)
    ]
    return _table(["capture", "method", *_columns(results)], rows)


@dataclass(frozen=True)
class Turn:
    """One turn of the rotation: the method that the other scenes choose, on the scene left out.

    `margin` is its lead over the second method on the other scenes, `difference` that over the best other method on
    the scene left out.
    """

    scene: str
    chosen: str
    margin: Figure
    score: Figure
    rival: str
    difference: Figure


def rotation(results: Results) -> list[Turn]:
    """Leave out each scene in turn; empty with fewer than two scenes or methods."""
    scenes = scenes_of(results.common)
    if len(scenes) < 2 or len(results.methods) < 2:
        return []
    turns = []
    for scene, captures in scenes.items():
        others = {name: of_scene for name, of_scene in scenes.items() if name != scene}
        there = {method: results.score(others, method) for method in results.methods}
        here = {method: results.score({scene: captures}, method) for method in results.methods}
        chosen, second = sorted(results.methods, key=lambda method: -there[method].value)[:2]
        rival = max((method for method in results.methods if method != chosen), key=lambda m: here[m].value)
        margin, difference = there[chosen].minus(there[second]), here[chosen].minus(here[rival])
        turns.append(Turn(scene, chosen, margin, here[chosen], rival, difference))
    return turns


def verdict(turns: list[Turn]) -> str:
    """Sentence that says whether a method is good: chosen whichever scene is left out, and the winner on it."""
    if not turns:
        return "A choice by rotation requires two scenes and two methods."
    by_result: dict[str, list[str]] = {}
    for turn in turns:
        by_result.setdefault(turn.difference.result, []).append(turn.scene)
    if "noise unknown" in by_result:
        return "No claim is made: the noise is unknown. Repeat trainings with other seeds (--seeds 0 1)."
    chosen = list(dict.fromkeys(turn.chosen for turn in turns))
    if len(chosen) > 1:
        return f"No method is good: the choice depends on the scene that is left out ({', '.join(chosen)})."
    if set(by_result) == {"win"}:
        return f"{chosen[0]} is good: it is chosen whichever scene is left out, and it wins on each of them."
    found = "; ".join(f"{result} on {', '.join(scenes)}" for result, scenes in by_result.items())
    return f"{chosen[0]} is chosen whichever scene is left out, but does not win on each of them: {found}."


def rotation_text(results: Results) -> str:
    """Markdown: a table of the rotation, and its verdict."""
    turns, psnr = rotation(results), QUANTITIES["psnr"]
    rows = [
        [
            turn.scene,
            turn.chosen,
            turn.margin.text(psnr),
            turn.score.text(psnr),
            turn.rival,
            turn.difference.text(psnr),
            turn.difference.result,
        ]
        for turn in turns
    ]
    head = ["left out", "best on the others", "its lead there, dB", "its PSNR on the scene left out, dB"]
    head += ["best other method on it", "difference, dB", "result"]
    return "\n\n".join([*([_table(head, rows)] if rows else []), verdict(turns)])


def failures_text(records: Iterable[Record]) -> str:
    """Markdown: a list of captures that could not be made or trained on, each reason once."""
    reasons = dict.fromkeys((r["scene"], r["failed"]) for r in records if "failed" in r)
    return "\n".join(f"* {scene}: {reason}" for scene, reason in reasons)


def summary(records: list[Record]) -> str:
    """Markdown: means by kind of capture, the rotation, and failures."""
    results = Results(records)
    parts = [groups_text(results), rotation_text(results)]
    if failed := failures_text(records):
        parts += ["Without a result:", failed]
    return "\n\n".join(part for part in parts if part)


def details(records: list[Record]) -> str:
    """Markdown: the table of all captures."""
    return captures_text(Results(records))
