"""Running experiments: a row each, whatever happens in it."""

import math
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from clsplat.bench.environment import commit, describe
from clsplat.bench.stability import EXPERIMENTS
from clsplat.device import Device
from clsplat.errors import InputError

Row = dict[str, Any]


def run_experiments(
    names: Iterable[str], device: Device, data: Path | None, progress: Callable[[str], None] = lambda text: None
) -> dict[str, Row]:
    """Run experiments by name, all of them if there is none.

    Returns
    -------
    dict of dict
        Per name: date, commit and device; and figures, plot and seconds, or `error` with what went wrong, or
        `not_run` with what it lacks.

    Raises
    ------
    InputError
        If a name is unknown.
    """
    chosen = list(dict.fromkeys(names)) or list(EXPERIMENTS)
    if unknown := [name for name in chosen if name not in EXPERIMENTS]:
        raise InputError(f"{unknown[0]}: expected experiments among {', '.join(EXPERIMENTS)}, found another name")
    about = {"date": describe(device)["date"], "commit": commit(), "device": device.label}
    rows = {}
    for name in chosen:
        progress(name)
        rows[name] = about | _run(name, device, data)
    return rows


def _run(name: str, device: Device, data: Path | None) -> Row:
    experiment = EXPERIMENTS[name]
    if experiment.needs_data and data is None:
        return {"not_run": "needs real scenes: --data"}
    started = time.perf_counter()
    try:
        figures, plot = experiment.measure(device, data)
    except Exception as error:  # a row that fails is a finding; the others are still measured
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
    """JSON has no numbers that are not finite."""
    return float(value) if value is not None and math.isfinite(value) else None
