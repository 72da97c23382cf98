"""Markdown and charts of the results of experiments on stability.

Results are rows by name, as `clsplat.bench.stability.run.run_experiments` returns them.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clsplat.atomic import replacing
from clsplat.bench.kernel_report import COLORS
from clsplat.bench.stability import EXPERIMENTS
from clsplat.bench.stability.experiment import Experiment

Results = dict[str, Any]
Experiments = Mapping[str, Experiment]


def _number(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.4g}" if value != 0 else "0"


def _text(figure: Results) -> str:
    return f"{_number(figure['value'])} {figure['unit']}".strip()


def _cells(experiment: Experiment, row: Results | None) -> tuple[str, str]:
    """Text of the cells without and with the remedy."""
    if row is None:
        return "not measured yet", ""
    if "error" in row:
        return f"failed: {row['error']}", ""
    texts = [f"{f['label']}: {_text(f)}" for f in row["figures"]]
    if experiment.remedy is None:
        return "; ".join(texts), "**open**"
    return texts[0], "; ".join(texts[1:])


def table(results: Results, experiments: Experiments = EXPERIMENTS) -> str:
    """Markdown table with a row for each experiment, measured or not."""
    lines = ["| failure | measured | without remedy | with | remedy | test |", "|---|---|---|---|---|---|"]
    for name, experiment in experiments.items():
        without, remedied = _cells(experiment, results.get(name))
        cells = (
            f"{experiment.failure} ({experiment.source})",
            experiment.figure,
            without,
            remedied,
            experiment.remedy or "none yet",
            f"`{experiment.test.removeprefix('tests/')}`",
        )
        lines.append("| " + " | ".join(cell.replace("|", r"\|").replace("\n", " ") for cell in cells) + " |")
    return "\n".join(lines)


def origin(results: Results, experiments: Experiments = EXPERIMENTS) -> str:
    """Markdown list of the devices, dates and commits that the rows were measured with."""
    measured: dict[tuple[str, str, str], list[str]] = {}
    for name in experiments:
        row = results.get(name, {})
        if "figures" in row:
            key = (row["device"], row["date"][:10], (row["commit"] or "unknown")[:8])
            measured.setdefault(key, []).append(name)
    return "\n".join(
        f"- {device}, {date}, commit {commit}: {', '.join(names)}"
        for (device, date, commit), names in measured.items()
    )


def charts(results: Results, experiments: Experiments = EXPERIMENTS) -> list[str]:
    """Names of the rows that have a chart."""
    return [name for name in experiments if "plot" in results.get(name, {})]


def chart_file(name: str) -> str:
    """Name of the file with a row's chart, in the folder of stability.json."""
    return f"stability-{name}.svg"


def save_chart(name: str, row: Results, path: Path, experiments: Experiments = EXPERIMENTS) -> None:
    """Draw a row's plot as an SVG file.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    plot = row["plot"]
    figure = Figure(figsize=(6.4, 3.6), dpi=150, layout="constrained")
    axes = figure.subplots()
    for (label, points), color, marker in zip(plot["series"].items(), COLORS, "os^Dvxp*", strict=False):
        x, y = zip(*[(a, float("nan") if b is None else b) for a, b in points], strict=True)
        axes.plot(x, y, color=color, linewidth=1.6, marker=marker, markersize=4.5, label=label)
    if "x" in plot["log"]:
        axes.set_xscale("log")
    if "y" in plot["log"]:
        axes.set_yscale("log")
    axes.set_xlabel(plot["x"])
    axes.set_ylabel(plot["y"])
    axes.set_title(experiments[name].failure, fontsize=10)
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9)
    # With a fixed salt and without a date, the same figures give the same file.
    with replacing(path) as file, rc_context({"svg.hashsalt": name}):
        figure.savefig(file, format="svg", metadata={"Title": f"{name}: {row['device']}", "Date": None})
