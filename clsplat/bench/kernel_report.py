"""Results of `clsplat bench kernels` as Markdown that is also readable on a terminal, and as a chart."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from clsplat.atomic import replacing
from clsplat.bench.workloads import SCALING_GAUSSIANS, SCALING_SIZES, scaling_names
from clsplat.errors import InputError

Results = dict[str, Any]

COLORS = ("#0072b2", "#e69f00", "#d55e00", "#009e73", "#56b4e9", "#cc79a7", "#8c6d1f", "#888888")
"""Colours of series, distinguishable with any colour vision (Okabe and Ito)."""


def table(rows: Iterable[Iterable[str]]) -> str:
    """Markdown table. The first row is the header; all columns except the first are right-aligned."""
    cells = [[str(cell) for cell in row] for row in rows]
    widths = [max(3, *(len(row[i]) for row in cells)) for i in range(len(cells[0]))]
    lines = [
        "| "
        + " | ".join(c.rjust(w) if i else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        + " |"
        for row in cells
    ]
    rule = "|" + "|".join("-" * (w + 2) if i == 0 else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return "\n".join([lines[0], rule, *lines[1:]])


def milliseconds(value: float) -> str:
    """Text of a time in milliseconds, with up to four digits."""
    return f"{value:.3f}" if value < 1 else f"{value:.4g}" if value < 1000 else f"{value:.0f}"


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.3g} %"


def origin(results: Results) -> list[str]:
    """Device, driver, software, date and load of a measurement, one line each."""
    device, software = results["device"], results["software"]
    facts = [
        f"{device['label']}, {device['compute_units']} compute units",
        f"driver {device['driver']}, {device['opencl']}",
        f"clsplat {software['clsplat']}, commit {software['commit'] or 'unknown'}",
        f"measured {results['date']}, {results['settings']['repeats']} repeats",
    ]
    if results["load"] is not None:
        facts.append(f"load average of the machine before the measurement: {results['load']:.2f}")
    return facts


def summary(results: Results) -> str:
    """The device, its limits, and a table with a row for each workload."""
    settings, roof = results["settings"], results["roof"]
    facts = origin(results)
    facts.append(f"compositor {settings['compositor']}, tiles of {settings['tile_size']} px")
    limits = [
        ("multiply-add", "exp", "exp2", "copy", "triad", "buffers", "launch", "queued"),
        (
            f"{roof['fma_gflops']:.4g} GFLOP/s",
            f"{roof['exp_gops']:.3g} G/s",
            f"{roof['exp2_gops']:.3g} G/s",
            f"{roof['copy_gbs']:.3g} GB/s",
            f"{roof['triad_gbs']:.3g} GB/s",
            f"{roof['buffer_mib']:.0f} MiB",
            f"{roof['launch_us']:.3g} us",
            f"{roof['queued_launch_us']:.3g} us",
        ),
    ]
    columns = (
        "workload",
        "tile lists",
        "pairs/px",
        "step, ms",
        "forward, ms",
        "of exp",
        "backward, ms",
        "of exp",
        "ratio",
    )
    rows = [columns]
    for w in results["workloads"]:
        fwd, bwd = (w["stages"][name] for name in ("composite_fwd", "composite_bwd"))
        pixels = w["width"] * w["height"]
        rows.append(
            (
                w["name"],
                f"{w['counts']['intersections'] / 1e6:.3g} M",
                f"{w['counts']['pairs_accepted'] / pixels:.1f}",
                milliseconds(w["step"]["median_ms"]),
                milliseconds(fwd["median_ms"]),
                _percent(fwd["roof_fraction"]),
                milliseconds(bwd["median_ms"]),
                _percent(bwd["roof_fraction"]),
                f"{w['step_over_compositing']:.2f}",
            )
        )
    return "\n\n".join(["\n".join(f"- {fact}" for fact in facts), table(limits), table(rows)])


def networks(results: Results) -> str:
    """Table of the networks of radiance fields; empty for results that have none."""
    roof = results["roof"]["fma_gflops"]
    rows: list[tuple[str, ...]] = [
        ("network", "rows", "forward, GFLOP/s", "of multiply-add", "backward, GFLOP/s", "of multiply-add")
    ]
    for network in results.get("networks", ()):
        rates = network["forward_gflops"], network["backward_gflops"]
        figures = [text for rate in rates for text in (f"{rate:.4g}", _percent(rate / roof))]
        rows.append((" - ".join(map(str, network["widths"])), f"{network['rows']:,}", *figures))
    return table(rows) if len(rows) > 1 else ""


def details(workload: Results) -> str:
    """Counts of a workload, and a table of its stages. A stage with several kernels is followed by a row for each."""
    counts, pixels = workload["counts"], workload["width"] * workload["height"]
    text = (
        f"{workload['name']}: {workload['gaussians']:,} Gaussians ({counts['visible']:,} visible, SH degree "
        f"{workload['sh_degree']}, {workload['mode']}), {workload['width']}x{workload['height']} px, "
        f"{counts['intersections']:,} intersections with tiles, {counts['pairs_evaluated']:,} pairs evaluated "
        f"({counts['pairs_evaluated'] / pixels:.1f} per px), {counts['pairs_accepted']:,} accepted "
        f"({counts['pairs_accepted'] / pixels:.1f} per px)"
    )
    rows = [("stage", "median, ms", "quartiles, ms", "CPU, ms", "rate", "of roof")]

    def row(name: str, s: Results) -> None:
        rate = f"{s['gpairs_per_s']:.3g} Gpairs/s" if "gpairs_per_s" in s else ""
        rate = f"{s['gb_per_s']:.3g} GB/s" if "gb_per_s" in s else rate
        roof = f"{_percent(s['roof_fraction'])} {s['roof']}" if "roof" in s else ""
        quartiles = f"{milliseconds(s['q1_ms'])}-{milliseconds(s['q3_ms'])}"
        rows.append(
            (
                name,
                milliseconds(s["median_ms"]),
                quartiles,
                milliseconds(s["cpu_ms"]) if "cpu_ms" in s else "",
                rate,
                roof,
            )
        )

    for name, stage in workload["stages"].items():
        row(name, stage)
        for kernel, s in stage["kernels"].items() if len(stage["kernels"]) > 1 else ():
            row(f"- {kernel}" + (f", {s['launches']} launches" if s["launches"] > 1 else ""), s)
    row("whole step", workload["step"])
    return f"{text}\n\n{table(rows)}"


def scaling_chart(results: Results, figure: Any) -> None:
    """Draw the time of the step and of its stages against the number of Gaussians and of pixels.

    Parameters
    ----------
    results : dict
        Result of `clsplat.bench.kernels.bench_kernels` for the workloads of `scaling_names`.
    figure : matplotlib.figure.Figure
        Empty, about 10 by 4.5 inches.
    """
    by_name = {w["name"]: w for w in results["workloads"]}
    count, size = SCALING_GAUSSIANS[2], SCALING_SIZES[2]
    panels = [
        (f"{size} pixels", "Gaussians", [f"{n}-{size}" for n in SCALING_GAUSSIANS], lambda w: w["gaussians"]),
        (f"{count} Gaussians", "pixels", [f"{count}-{s}" for s in SCALING_SIZES], lambda w: w["width"] * w["height"]),
    ]
    missing = sorted(set(scaling_names()) - set(by_name))
    if missing:
        raise InputError(
            f"scaling chart: expected results of {', '.join(missing)}, found none; measure with --scaling"
        )
    for axes, (title, label, names, position) in zip(figure.subplots(1, 2, sharey=True), panels, strict=True):
        workloads = [by_name[name] for name in names]
        x = [position(w) for w in workloads]
        steps = [w["step"]["median_ms"] for w in workloads]
        axes.loglog(x, steps, color="black", linewidth=2.2, marker="o", markersize=5, label="whole step")
        stages = list(workloads[-1]["stages"])
        for stage, color in zip(stages, COLORS, strict=False):
            y = [w["stages"][stage]["median_ms"] for w in workloads]
            axes.loglog(x, y, color=color, linewidth=1.4, marker="o", markersize=3, label=stage)
        # A line proportional to x through the time of the last step.
        axes.loglog(
            x, [steps[-1] * value / x[-1] for value in x], color="0.75", linestyle="--", label="in proportion"
        )
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(label)
        axes.set_xticks(x, [f"{value / 1e6:.2g}M" if value >= 1e6 else f"{value / 1e3:.3g}k" for value in x])
        axes.minorticks_off()
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.yaxis.set_major_formatter("{x:g}")
    figure.axes[0].set_ylabel("median time, ms")
    figure.axes[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=9)
    figure.suptitle(f"{results['device']['label']}, {results['date'][:10]}", fontsize=9, color="0.4")


def chart_title(results: Results) -> str:
    """Title in the metadata of a chart's file: device and date of the results."""
    return f"{results['benchmark']}: {results['device']['label']}, {results['date']}"


def save_scaling_chart(results: Results, path: Path) -> None:
    """Write `scaling_chart` to a file, in the format of its suffix.

    Raises
    ------
    InputError
        If workloads are missing or the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.6), dpi=150, layout="constrained")
    scaling_chart(results, figure)
    with replacing(path) as file:
        figure.savefig(file, format=path.suffix[1:].lower(), metadata={"Title": chart_title(results)})
