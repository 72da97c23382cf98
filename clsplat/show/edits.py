"""Edits of a scene: selection, deletion and cropping of Gaussians, with undo."""

from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians

Mask = NDArray[np.bool_]

HISTORY = 100
"""Number of deletions that can be undone. Each takes a bit for each Gaussian."""

NEIGHBOURS = 8
SPREAD_MAX = 2.0
"""A Gaussian is isolated if its mean distance to this number of neighbours exceeds the mean of all by this number of
standard deviations (Rusu and Cousins 2011, "3D is here: Point Cloud Library", statistical outlier removal). Both are
taken of logarithms, because the distances in a scene span orders of magnitude."""

HIGHLIGHT = (1.0, 0.45, 0.0)
"""Colour of selected Gaussians, RGB: that of the cameras' outlines, which is rare in photos."""


class Region(NamedTuple):
    """A box with axes along those of the world, or a sphere: centre (3,) and half edges or radius, world units."""

    shape: Literal["box", "sphere"]
    centre: tuple[float, float, float]
    reach: tuple[float, float, float]
    """Half edges of a box; the first is the radius of a sphere."""

    def holds(self, points: NDArray[Any]) -> Mask:
        """Whether each of the points (N, 3) is inside."""
        away = np.asarray(points, np.float64) - self.centre
        if self.shape == "sphere":
            return np.asarray((away**2).sum(axis=1) <= self.reach[0] ** 2)
        return np.asarray((np.abs(away) <= self.reach).all(axis=1))


class Edits:
    """A scene with what was deleted and what is selected.

    Parameters
    ----------
    gaussians : Gaussians
        On the host; not changed.

    Attributes
    ----------
    kept, selected : (N,) bool
        Gaussians that are not deleted, and those of them that are selected.
    """

    def __init__(self, gaussians: Gaussians):
        self._all = gaussians
        self.kept: Mask = np.ones(len(gaussians), bool)
        self.selected: Mask = np.zeros(len(gaussians), bool)
        self._region: Region | None = None
        self._history: list[NDArray[np.uint8]] = []

    def __len__(self) -> int:
        return int(self._visible().sum())

    @property
    def steps(self) -> int:
        """Number of deletions that can be undone."""
        return len(self._history)

    @property
    def region(self) -> Region | None:
        """Region outside which nothing is shown, selected or saved; None without one."""
        return self._region

    @region.setter
    def region(self, region: Region | None) -> None:
        self._region = region
        self.selected = self._inside(self.selected)

    def _inside(self, mask: Mask) -> Mask:
        return mask if self._region is None else mask & self._region.holds(self._all.means)

    def _visible(self) -> Mask:
        return self._inside(self.kept)

    def select_rectangle(self, camera: Camera, low: tuple[float, float], high: tuple[float, float]) -> None:
        """Select the visible Gaussians whose centres a pinhole camera sees in a rectangle, besides those selected.

        `low` and `high` are corners as fractions of the image's width and height.
        """
        x, y, z = camera.viewmat[:3, :3] @ self._all.means.T.astype(np.float64) + camera.viewmat[:3, 3:]
        ahead = z > 0
        depth = np.where(ahead, z, 1.0)
        u = (x / depth * camera.fx + camera.cx) / camera.width
        v = (y / depth * camera.fy + camera.cy) / camera.height
        inside = (u >= low[0]) & (u <= high[0]) & (v >= low[1]) & (v <= high[1])
        self.selected |= self._visible() & ahead & inside

    def select_isolated(self) -> None:
        """Select the visible Gaussians that are far from their neighbours, besides those selected."""
        from scipy.spatial import cKDTree

        rows = np.flatnonzero(self._visible())
        if len(rows) <= NEIGHBOURS:
            return
        points = self._all.means[rows].astype(np.float64)
        distances = cKDTree(points).query(points, NEIGHBOURS + 1)[0][:, 1:].mean(axis=1)
        logs = np.log(np.maximum(distances, 1e-300))
        self.selected[rows[logs > logs.mean() + SPREAD_MAX * logs.std()]] = True

    def select_none(self) -> None:
        """Select nothing."""
        self.selected[:] = False

    def delete(self) -> int:
        """Delete what is selected, and return its number.

        Raises
        ------
        InputError
            If none that is shown would remain; nothing is deleted then.
        """
        return self._keep(self.kept & ~self.selected)

    def crop(self) -> int:
        """Delete what is outside the region, and return its number."""
        return self._keep(self._visible())

    def _keep(self, kept: Mask) -> int:
        if not self._inside(kept).any():
            where, remedy = ("", "") if self.region is None else (" in the crop region", ", or turn the crop off")
            raise InputError(f"expected at least one Gaussian to remain{where}, found none; select fewer{remedy}")
        count = int(self.kept.sum() - kept.sum())
        if count:
            self._history = [*self._history, np.packbits(self.kept)][-HISTORY:]
        self.kept = kept
        self.select_none()
        return count

    def undo(self) -> None:
        """Bring back what was deleted last, selected."""
        if self._history:
            before = np.unpackbits(self._history.pop(), count=len(self._all)).astype(bool)
            self.selected, self.kept = self._inside(before & ~self.kept), before

    def result(self) -> Gaussians:
        """The Gaussians that are neither deleted nor outside the region.

        Raises
        ------
        InputError
            If none is left.
        """
        visible = self._visible()
        if not visible.any():
            raise InputError("the region holds no Gaussian")
        return self._all.take(np.flatnonzero(visible))

    def shown(self) -> Gaussians:
        """The result, with the selected Gaussians in the colour `HIGHLIGHT`."""
        gaussians = self.result()
        rows = np.flatnonzero(self.selected[self._visible()])
        if not len(rows):
            return gaussians
        sh = gaussians.sh.copy()
        sh[rows] = 0
        sh[rows, 0] = (np.array(HIGHLIGHT) - 0.5) / SH_C0
        return replace(gaussians, sh=sh)
