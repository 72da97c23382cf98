"""The model of the time of a step as Markdown that is also readable on a terminal."""

from typing import Any

import numpy as np

from clsplat.bench.kernel_report import milliseconds, table
from clsplat.bench.time_model import HARDWARE, OTHERS, TERMS, checked, model_of, predicted

Results = dict[str, Any]

COLUMNS = ("launches", "bytes", "exps", "operations")


def model_text(results: Results) -> str:
    """Coefficients of the model, its errors on workloads that were left out, and, from a GPU, predictions for others.

    GPUs run other kernels than CPUs, so that a CPU's results predict no GPU (docs/benchmarks.md).

    Parameters
    ----------
    results : dict
        Of `clsplat.bench.kernels.bench_kernels`, with at least seven workloads.
    """
    model, errors = model_of(results), checked(results)
    rows: list[tuple[str, ...]] = [("stage", *COLUMNS, "median error", "largest error")]
    for stage, found in errors.items():
        named = dict(zip(TERMS.get(stage, OTHERS), model.get(stage, ()), strict=False))
        cells = [f"{named[name]:.3g}" if name in named else "" for name in COLUMNS]
        name = f"`{stage}`" if stage in model else "whole step"
        rows.append((name, *cells, _percent(np.median(np.abs(found))), _percent(np.abs(found).max())))
    if results["device"]["kind"] == "cpu":
        return table(rows)
    largest = max(results["workloads"], key=lambda w: w["gaussians"] * w["width"] * w["height"])
    times = {hardware.name: predicted(model, largest, hardware.limits) for hardware in HARDWARE}
    header = ("device, step of " + largest["name"], "step, ms", *(f"`{stage}`" for stage in model))
    forecasts = [
        (name, milliseconds(1e3 * sum(stages.values())), *(milliseconds(1e3 * time) for time in stages.values()))
        for name, stages in times.items()
    ]
    sources = "\n".join(f"* {hardware.name}: {hardware.source}." for hardware in HARDWARE)
    return f"{table(rows)}\n\n{table([header, *forecasts])}\n\n{sources}"


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.0f} %"
