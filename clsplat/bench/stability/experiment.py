"""The types of an experiment on stability and of its results."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple


class Figure(NamedTuple):
    """One number. The label names the variant: without the remedy, with it, or with an alternative."""

    label: str
    value: float
    unit: str = ""


class Plot(NamedTuple):
    """A chart: axis labels, points (x, y) by series (a y of None leaves a gap), and the logarithmic axes."""

    x: str
    y: str
    series: dict[str, list[tuple[float, float | None]]]
    log: Literal["", "x", "y", "xy"] = ""


class Found(NamedTuple):
    """Results of an experiment: first the figure without the remedy, then with it and with alternatives."""

    figures: list[Figure]
    plot: Plot | None = None


@dataclass(frozen=True)
class Experiment:
    """A known failure of the method, and how it is measured without and with the remedy.

    Parameters
    ----------
    failure : str
        Name of the failure, as on docs/stability.md.
    source : str
        Paper or issue that describes it.
    remedy : str or None
        The remedy, with its option where there is one. None if there is no remedy yet.
    test : str
        A test that fails without the remedy, as tests/stability/FILE.py::NAME.
    measure : callable
        Runs the experiment on a `Device` and returns a `Found`.
    figure : str
        Description of the figures.
    """

    failure: str
    source: str
    remedy: str | None
    test: str
    measure: Callable[..., Found]
    figure: str
