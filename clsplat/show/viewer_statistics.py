"""Curves of a training in the viewer: PSNR of held-out photos, number of Gaussians, iterations per second."""

import time
from typing import Any

import numpy as np

EVERY = 1.0
"""Time between two points of a curve, s. The speed is the mean over it."""

POINTS_MAX = 400
"""Largest number of points of a curve; beyond it every other one is dropped. The panel is as many pixels wide."""

HEIGHT, LABELS = 120, 60
"""Height of a curve and width of the labels of its y axis, px; a label can be 1,000,000."""


class Statistics:
    """Curves, drawn with viser's plots.

    Parameters
    ----------
    gui : viser.GuiApi
    """

    def __init__(self, gui: Any):
        self._points: dict[str, list[tuple[float, float]]] = {name: [] for name in ("PSNR, dB", "Gaussians", "it/s")}
        self._plots = {name: self._plot(gui, name) for name in self._points}
        self._at = time.perf_counter()
        self._iteration: int | None = None

    @staticmethod
    def _plot(gui: Any, name: str) -> Any:
        series = ({"label": "iteration"}, {"label": name, "stroke": "#d55e00", "width": 2})
        data = (np.zeros(0), np.zeros(0))
        options = {"scales": {"x": {"time": False}}, "axes": ({}, {"size": LABELS}), "legend": {"show": False}}
        return gui.add_uplot(data, series, title=name, height=HEIGHT, **options)

    def add(self, iteration: int, count: int, psnr: float | None) -> None:
        """Add the state after an iteration; PSNR is None where photos were not evaluated."""
        now = time.perf_counter()
        if psnr is not None:
            self._append("PSNR, dB", iteration, psnr)
        if self._iteration is None:
            self._at, self._iteration = now, iteration
        elif now - self._at >= EVERY:
            self._append("Gaussians", iteration, count)
            self._append("it/s", iteration, (iteration - self._iteration) / (now - self._at))
            self._at, self._iteration = now, iteration

    def _append(self, name: str, iteration: int, value: float) -> None:
        points = self._points[name]
        points.append((iteration, value))
        if len(points) > POINTS_MAX:
            del points[1:-1:2]
        self._plots[name].data = tuple(np.array(points, np.float64).T)
