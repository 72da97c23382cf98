"""Run experiments, and keep their results in a file of rows."""

import json
import math
import time
import traceback
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from clsplat.atomic import replacing
from clsplat.bench.environment import commit, describe
from clsplat.bench.stability import EXPERIMENTS
from clsplat.bench.stability.experiment import Experiment
from clsplat.bench.stability.stability_report import chart_file, charts, save_chart
from clsplat.device import Device
from clsplat.errors import InputError, new_folder

Row = dict[str, Any]

FILE = "stability.json"
"""Name of the file with the rows."""


def run_experiments(
    names: Iterable[str],
    device: Device,
    progress: Callable[[str], None] = lambda text: None,
    experiments: Mapping[str, Experiment] = EXPERIMENTS,
) -> dict[str, Row]:
    """Run experiments by name, or all of them if no name is given.

    Parameters
    ----------
    names : iterable of str
    device : Device
    progress : callable
        Receives the name of each experiment before it runs.
    experiments : mapping of Experiment
        Table that the names refer to.

    Returns
    -------
    dict of dict
        Row by name: date, commit and device; and either figures, seconds and, for some, a plot, or `error` with the
        reason of the failure.

    Raises
    ------
    InputError
        If a name is unknown.
    """
    chosen = list(dict.fromkeys(names)) or list(experiments)
    if unknown := [name for name in chosen if name not in experiments]:
        raise InputError(f"{unknown[0]}: expected experiments among {', '.join(experiments)}, found another name")
    about = {"date": describe(device)["date"], "commit": commit(), "device": device.label}
    rows = {}
    for name in chosen:
        progress(name)
        rows[name] = about | _run(experiments[name], device)
    return rows


def measure_rows(
    names: Iterable[str],
    device: Device,
    out: Path | None,
    say: Callable[[str], None],
    experiments: Mapping[str, Experiment] = EXPERIMENTS,
) -> tuple[dict[str, Row], list[str]]:
    """Run experiments and add their rows to the file stability.json of a folder.

    Rows of the file that are not measured now stay as they are.

    Parameters
    ----------
    names : iterable of str
        As for `run_experiments`.
    device : Device
    out : Path or None
        Folder of the file, and of the charts; it is created. None writes nothing.
    say : callable
        Receives messages about the progress.
    experiments : mapping of Experiment
        As for `run_experiments`.

    Returns
    -------
    dict of dict
        All rows: those of the file, and those measured now.
    list of str
        Names of the experiments that failed now.

    Raises
    ------
    InputError
        If a name is unknown, the folder cannot be created, or its file cannot be read or written.
    """
    if out is not None:
        new_folder(out)
    results = _read(out / FILE) if out is not None else {}
    say(f"device: {device.label}")
    rows = run_experiments(names, device, lambda name: say(f"measuring: {name}"), experiments)
    results |= rows
    if out is not None:
        with replacing(out / FILE) as file:
            file.write((json.dumps(results, indent=1, allow_nan=False) + "\n").encode())
        for name in charts(rows, experiments):
            save_chart(name, rows[name], out / chart_file(name), experiments)
        say(f"results: {out / FILE}")
    return results, [name for name, row in rows.items() if "error" in row]


def _read(path: Path) -> dict[str, Row]:
    if not path.exists():
        return {}
    try:
        results = json.loads(path.read_bytes())
        if not isinstance(results, dict):
            raise ValueError(f"a {type(results).__name__}")
        return results
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected results of an earlier run, found: {error}") from error


def _run(experiment: Experiment, device: Device) -> Row:
    started = time.perf_counter()
    try:
        figures, plot = experiment.measure(device)
    except Exception as error:  # a failed experiment is a result; the others still run
        traceback.print_exc()
        return {"error": f"{type(error).__name__}: {error}"}
    row: Row = {
        "figures": [{"label": f.label, "value": _finite(f.value), "unit": f.unit} for f in figures],
        "seconds": round(time.perf_counter() - started, 1),
    }
    if plot is not None:
        series = {label: [[x, _finite(y)] for x, y in points] for label, points in plot.series.items()}
        row["plot"] = {"x": plot.x, "y": plot.y, "log": plot.log, "series": series}
    return row


def _finite(value: float | None) -> float | None:
    """None if the value is not finite: JSON cannot express such numbers."""
    return float(value) if value is not None and math.isfinite(value) else None
