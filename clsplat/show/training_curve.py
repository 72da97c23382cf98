"""The training log as a chart."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.atomic import replacing
from clsplat.errors import InputError
from clsplat.json_lines import KNOWN, NUMBER, read_json_lines

KINDS = {"iteration": (int,), "num_gaussians": (int,), "seconds": NUMBER, "loss": NUMBER, "psnr": KNOWN}
"""Types of the entries of a training log that are used."""


def read_log(path: Path, needed: Collection[str] = ("iteration", "num_gaussians", "seconds")) -> list[dict[str, Any]]:
    """Read the records of a training log, in the order of the file.

    A last line without a line end is still being written and is ignored.

    Parameters
    ----------
    path : Path
    needed : collection of str
        Entries of every record. The log of a radiance field has no num_gaussians.

    Raises
    ------
    InputError
        If the log cannot be read, is empty or has an invalid line.
    """
    records = read_json_lines(path, "a record of training", KINDS, needed)
    if not records:
        raise InputError(f"{path}: expected the records of a training run, found none")
    return records


def training_curve(log: Path, path: Path) -> None:
    """Draw a training log as a PNG: loss and PSNR of held-out photos, and below them the number of Gaussians.

    Parameters
    ----------
    log : Path
        JSON objects, one per line, with iteration, num_gaussians, seconds, and loss, psnr or both. A last line
        without a line end is still being written and is ignored.
    path : Path
        The PNG.

    Raises
    ------
    InputError
        If the log cannot be read, is empty or has an invalid line, or if the PNG cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    records = read_log(log)
    figure = Figure(figsize=(8, 5.5), dpi=150, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    for axes in (upper, lower):
        axes.grid(color="0.9")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}"))

    blue, orange, green = "#0072b2", "#d55e00", "#009e73"  # Okabe and Ito: distinguishable with any colour vision
    losses = np.array([(r["iteration"], r["loss"]) for r in records if "loss" in r]).reshape(-1, 2)
    if len(losses):
        width = max(1, len(losses) // 50)  # the loss differs more between photos than it falls within a window
        smooth = np.convolve(losses[:, 1], np.ones(width) / width, mode="valid")
        first = (width - 1) // 2
        upper.semilogy(*losses.T, color=blue, alpha=0.25, linewidth=0.8)
        upper.semilogy(losses[first : first + len(smooth), 0], smooth, color=blue, linewidth=1.6)
        upper.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 4, 5, 7)))
        upper.yaxis.set_major_formatter("{x:.3g}")
        upper.yaxis.set_minor_formatter(NullFormatter())
    upper.set_ylabel("training loss", color=blue)
    last = records[-1]
    title = f"{last['iteration']:,} iterations · {last['num_gaussians']:,} Gaussians · {last['seconds']:.0f} s"
    scores = np.array([(r["iteration"], r["psnr"]) for r in records if r.get("psnr") is not None]).reshape(-1, 2)
    if len(scores):
        right = upper.twinx()
        right.plot(*scores.T, color=orange, marker="o", markersize=4)
        right.set_ylabel("held-out PSNR (dB)", color=orange)
        right.spines[["top", "left"]].set_visible(False)
        title += f" · {scores[-1, 1]:.2f} dB"
    upper.set_title(title, fontsize="medium")
    lower.plot([r["iteration"] for r in records], [r["num_gaussians"] for r in records], color=green)
    lower.set_ylim(bottom=0)
    lower.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}"))
    lower.set_ylabel("Gaussians")
    lower.set_xlabel("iteration")
    with replacing(path) as file:
        figure.savefig(file, format="png", metadata={"Software": None})
