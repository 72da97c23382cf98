"""The cut of a scene into boxes: a kd-tree over the Gaussians of the coarse run, and a margin around each box."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MARGIN = 0.1
"""Width of the margin of a box at each face that another box shares, as a fraction of the extent along this axis of
the Gaussians in the box."""

SPREAD = (0.05, 0.95)
"""Quantiles of the Gaussians' positions along an axis whose difference is their extent. Single Gaussians lie far away
from the others."""


class Box(NamedTuple):
    """Half-open box of the world: low <= point < high, world units; infinite at faces that no other box shares."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (N, 3) are in the box, (N,)."""
        return np.asarray(((points >= self.low) & (points < self.high)).all(axis=1))

    def meets(self, low: Array, high: Array) -> NDArray[np.bool_]:
        """Whether boxes from `low` to `high` (N, 3), which contain both, may share a point with this one, (N,)."""
        return np.asarray(((high >= self.low) & (low < self.high)).all(axis=1))

    def widened(self, points: Array, by: float) -> "Box":
        """The box with a margin of the width `by`, in extents of those of the points (N, 3) that are in it."""
        inside = points[self.contains(points)]
        margins = by * _extent(inside) if len(inside) else np.zeros(3)
        low, high = np.asarray(self.low) - margins, np.asarray(self.high) + margins  # infinity stays infinite
        return Box(tuple(low.tolist()), tuple(high.tolist()))


EVERYWHERE = Box((-np.inf,) * 3, (np.inf,) * 3)


class Block(NamedTuple):
    """A part of the scene.

    box: what it keeps; wide: what it trains, with the margin; near: what later trainings draw as it was trained;
    photos: indices of training photos; gaussians: expected number, margin included; backdrop: expected Gaussians
    that its photos show around it in any training; visits: photos, each counted by the part that the block
    fills, over `WHOLE`.
    """

    box: Box
    wide: Box
    near: Box
    photos: NDArray[np.intp]
    gaussians: int
    backdrop: int
    visits: float


def cut(points: Array, count: int, costs: Array | None = None, between: bool = False) -> list[Box]:
    """Cut space into boxes that cost about the same.

    Each box is cut in two across the axis along which its points extend farthest, at the quantile that gives both
    sides their share of the boxes (Bentley 1975, "Multidimensional binary search trees").

    Parameters
    ----------
    points : (N, 3)
        Positions, world units.
    count : int
        Number of boxes, at least 1.
    costs : (N,), optional
        Cost that each point adds to its box, above 0. Default: the same for all.
    between : bool
        Make another cut, whose borders are in the boxes of the usual one: there is a box more, the first and the last
        cost half as much as the others, and boxes are divided at a third instead of half of their parts.

    Returns
    -------
    list of Box
        `count` boxes, or one more; each point of space is in exactly one.
    """
    costs = np.ones(len(points)) if costs is None else costs
    parts = [0.5, *[1.0] * (count - 1), 0.5] if between else [1.0] * count
    return _cut(np.asarray(points, np.float64), costs, EVERYWHERE, parts, 3 if between else 2)


def _cut(points: Array, costs: Array, box: Box, parts: list[float], divisor: int) -> list[Box]:
    if len(parts) == 1:
        return [box]
    first = max(1, len(parts) // divisor)
    axis, at = 0, 0.0
    if len(points):
        axis = int(_extent(points).argmax())
        at = _quantile(points[:, axis], costs, sum(parts[:first]) / sum(parts))
    low, high = [*box.low], [*box.high]
    low[axis] = high[axis] = at
    left = points[:, axis] < at
    return [
        *_cut(points[left], costs[left], Box(box.low, tuple(high)), parts[:first], divisor),
        *_cut(points[~left], costs[~left], Box(tuple(low), box.high), parts[first:], divisor),
    ]


def _quantile(values: Array, costs: Array, share: float) -> float:
    """The middle between two values, of which the lower ones have the given share of the costs."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(costs[order])
    last = min(int(np.searchsorted(sums, share * sums[-1])), len(order) - 1)
    return float(values[order[last : last + 2]].mean())


def _extent(points: Array) -> Array:
    low, high = np.quantile(points, SPREAD, axis=0)
    return np.asarray(high - low)
