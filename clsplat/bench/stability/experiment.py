"""What an experiment on stability is, and what it finds."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from clsplat.device import Device


class Figure(NamedTuple):
    """One number: what it was measured with (without the remedy, with it, with another), and its unit."""

    label: str
    value: float
    unit: str = ""


class Plot(NamedTuple):
    """A chart: per series its points (x, y), where a y of None leaves a gap; `log` names the logarithmic axes."""

    x: str
    y: str
    series: dict[str, list[tuple[float, float | None]]]
    log: Literal["", "x", "y", "xy"] = ""


class Found(NamedTuple):
    """What an experiment measured: the figure without the remedy first, then with it and with what competes."""

    figures: list[Figure]
    plot: Plot | None = None


@dataclass(frozen=True)
class Experiment:
    """A way in which the method fails, and how that is measured without and with the remedy.

    Parameters
    ----------
    failure : str
        In words, as on docs/stability.md.
    source : str
        Where it is known from: paper, issue.
    remedy : str or None
        What holds it off, with the name of its option where there is one; None where the row is open.
    test : str
        What fails without the remedy, as tests/stability/FILE.py::NAME.
    measure : callable
        From the device and the folder of real scenes (None where there is none) to what was found.
    figure : str
        What the figures count, in words.
    needs_data : bool
        The experiment does not run without real scenes.
    """

    failure: str
    source: str
    remedy: str | None
    test: str
    measure: Callable[[Device, Path | None], Found]
    figure: str
    needs_data: bool = False
