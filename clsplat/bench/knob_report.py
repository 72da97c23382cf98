"""Results of `clsplat bench knobs` as Markdown and as a chart."""

from pathlib import Path
from typing import Any

from clsplat.atomic import replacing
from clsplat.bench.kernel_report import COLORS, Results, chart_title, milliseconds, origin, table

PANELS = (("render", "rendering"), ("step", "a step of training"))

FLOOR = 1e-9
"""Smallest error on the chart. Smaller ones, such as that of float64, are drawn here as triangles."""

TICKS = (0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100)


def knobs_text(results: Results) -> str:
    """Environment of the measurement, and a table for each workload."""
    parts = ["\n".join(f"- {fact}" for fact in origin(results))]
    for w in results["workloads"]:
        title = (
            f"{w['name']}: {w['gaussians']:,} Gaussians, {w['width']}x{w['height']} px, SH degree {w['sh_degree']}, "
            f"{w['mode']}"
        )
        parts += [title, table([_columns(results), *(_row(r, results) for r in w["results"])])]
    return "\n\n".join(parts)


def _columns(results: Results) -> list[str]:
    times = ["ms", "CPU ms", "ratio"] if results["device"]["kind"] == "cpu" else ["ms", "ratio"]
    kinds = [f"{job}, {time}" for job, _ in PANELS for time in times]
    return ["knob", "value", *kinds, "largest error", "PSNR, dB"]


def _row(result: Results, results: Results) -> list[str]:
    cells = [result["knob"], result["value"]]
    for job, _ in PANELS:
        times = result[job]
        keys = ["median_ms", "cpu_ms"] if results["device"]["kind"] == "cpu" else ["median_ms"]
        cells += [milliseconds(times[key]) if times else "" for key in keys]
        cells.append(f"{times['ratio']:.2f}" if times else "")
    return [*cells, f"{result['error']['max_abs']:.1e}", f"{result['error']['psnr']:.1f}"]


def knobs_chart(workload: Results, figure: Any) -> None:
    """Draw the error of every setting against its time: rendering on the left, training on the right.

    Parameters
    ----------
    workload : dict
        An entry of `workloads` in the result of `clsplat.bench.knobs.bench_knobs`.
    figure : matplotlib.figure.Figure
        Empty, about 13 by 6 inches.
    """
    knobs = list(dict.fromkeys(r["knob"] for r in workload["results"]))
    # Colours repeat after eight settings. The labels distinguish them.
    colors = dict(zip(knobs, ("black", *COLORS, *COLORS), strict=False))
    for axes, (job, title) in zip(figure.subplots(1, 2), PANELS, strict=True):
        axes.axvline(1, color="0.8", linewidth=1, zorder=0)
        points = []
        for r in filter(lambda r: r[job], workload["results"]):
            x, rms, color = r[job]["ratio"], r["error"]["rms"], colors[r["knob"]]
            axes.loglog(x, max(rms, FLOOR), color=color, marker="o" if rms > FLOOR else "v", markersize=5)
            points.append((max(rms, FLOOR), x, f"{r['knob']} {r['value']}".rstrip(), color))
        # Among equal errors, the slowest label is the lowest, so that the lines to the labels do not cross.
        for i, (y, x, name, color) in enumerate(sorted(points, key=lambda p: (float(f"{p[0]:.1e}"), -p[1]))):
            line = {"arrowstyle": "-", "color": color, "linewidth": 0.6, "alpha": 0.5, "relpos": (0, 0.5)}
            at = (1.06, (i + 0.5) / len(points))
            text = {"fontsize": 8, "color": color, "va": "center"}
            axes.annotate(name, (x, y), at, textcoords="axes fraction", arrowprops=line, **text)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("time relative to the default")
        axes.set_ylim(FLOOR / 2, 1)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.set_xticks([t for t in TICKS if axes.get_xlim()[0] <= t <= axes.get_xlim()[1]])
        axes.grid(color="0.94")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("root-mean-square error against the float64 twin")


def save_knobs_chart(results: Results, path: Path) -> None:
    """Write `knobs_chart` of the first workload to a file, in the format of its suffix."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.5), dpi=150, layout="constrained")
    workload = results["workloads"][0]
    knobs_chart(workload, figure)
    title = f"{workload['name']}, {results['device']['label']}, {results['date'][:10]}"
    figure.suptitle(title, fontsize=9, color="0.4")
    with replacing(path) as file:
        figure.savefig(file, format=path.suffix[1:].lower(), metadata={"Title": chart_title(results)})
