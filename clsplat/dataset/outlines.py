"""The place of an object before a plain background, from its outlines in the photos.

Few photos from all sides have few features in common, so that no points can be triangulated. But the object lies
where no photo shows the background: in its visual hull (Laurentini 1994, doi:10.1109/34.273735), which is carved out
of a grid (Martin and Aggarwal 1983, doi:10.1109/TPAMI.1983.4767367). What is carved away stays free: Gaussians of the
background's colour there would be seen from new viewpoints only, where they hide the object. Measured:
docs/experiments/strategies.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import focus_point
from clsplat.dataset.coverage import projected
from clsplat.randomness import stream
from clsplat.ranges import FLOAT32_TINY
from clsplat.scene import View, evenly_spaced, in_turn

Array = NDArray[np.float64]

MOST_PHOTOS = 100
"""Largest number of photos whose outlines are compared, evenly spaced, which bounds the time."""

FEWEST_PHOTOS = 3
"""Fewest photos whose outlines are compared: the hull of two reaches far behind the object."""

TOLERANCE = 0.06
"""Largest difference of a background's colour from its median, from 0 to 1: several times the noise of a photo."""

PLAIN = 0.6
"""Least fraction of the pixels on the photos' edges that have the background's colour: an object may reach beyond the
edges, but a room has no such colour."""

PLAIN_EDGE = 0.5
"""Least fraction of the pixels on each of the four edges that has the background's colour (measured:
docs/experiments/strategies.md)."""

EDGES: tuple[Any, ...] = (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1])
"""The four edges of a photo."""

SHOWN = 0.5
"""Least fraction of the photos that have a point of the hull in their frames."""

OUTSIDE = 0.1
"""Largest fraction of the photos with a point in their frames that show the background there: a part of the object
may have the background's colour in one of them."""

GRIDS = (64, 64, 96)
"""Largest numbers of cells along an edge of the grids, and no more than pixels along the photos' longer edge: around
all cameras, around what their frames have in common, in which the object is found, and around the object."""

SEED = 0
"""Seed of the places of points within their cells."""


@dataclass(frozen=True)
class Grid:
    """A cube of cells: its centre (3,) and half its edge, world units, and whether a cell is free (n, n, n)."""

    centre: Array
    half: float
    free: NDArray[np.bool_]


def points_of_outlines(views: list[View]) -> tuple[Array, NDArray[np.uint8]]:
    """Find points on the surface of the visual hull of an object.

    Parameters
    ----------
    views : list of View
        Photos of the object from several sides.

    Returns
    -------
    points : (P, 3) float64
        One in each cell of the grid on the hull's surface, world units. P is 0 if the background is not plain, or no
        place is inside the outlines.
    colors : (P, 3) uint8
        Their mean colours in the photos that do not show the background there.
    """
    return _compared(views)[1:]


def free_space(views: list[View]) -> list[Grid]:
    """Find the cells of space in which no object is, since photos show a plain background behind them.

    Parameters
    ----------
    views : list of View
        Photos of an object from several sides.

    Returns
    -------
    list of Grid
        Grids around the object, the finest first. A cell is free if all around it are, for outlines are not exact.
        Empty if the background is not plain.
    """
    from scipy.ndimage import binary_erosion

    around = np.ones((3, 3, 3), bool)
    return [replace(g, free=binary_erosion(g.free, around)) for g in reversed(_compared(views)[0])]


def in_free_space(points: ArrayLike, grids: Sequence[Grid]) -> NDArray[np.bool_]:
    """Whether points (P, 3) are in cells that are free in the finest of the grids that has them."""
    points = np.asarray(points, np.float64)
    found, free = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for grid in grids:
        count = len(grid.free)
        cells = np.floor((points - grid.centre) / (2 * grid.half) * count + count / 2)
        inside = ~found & ((cells >= 0) & (cells < count)).all(axis=1)
        free[inside] = grid.free[tuple(cells[inside].astype(int).T)]
        found |= inside
    return free


def _compared(views: list[View]) -> tuple[list[Grid], Array, NDArray[np.uint8]]:
    """The grids, the coarsest first, and the points and colours of `points_of_outlines`."""
    from scipy.ndimage import binary_erosion

    grids: list[Grid] = []
    points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    views = evenly_spaced(views, MOST_PHOTOS)
    color = plain_color(views) if len(views) >= FEWEST_PHOTOS else None
    if color is None:
        return grids, points, colors
    cameras = [view.camera for view in views]
    centre = focus_point(cameras)
    distances = [np.linalg.norm(camera.position - centre) for camera in cameras]
    frame = float(np.median(distances) * np.median([max(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]))
    half = max(float(max(distances)), frame)
    edge = max(max(camera.width, camera.height) for camera in cameras)
    for count in (min(most, edge) for most in GRIDS):
        middles = half * ((2 * np.arange(count) + 1) / count - 1)
        places = centre + np.stack(np.meshgrid(*[middles] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        inside, free, found = _carved(places, views, color)
        volume = inside.reshape([count] * 3)
        grids.append(Grid(centre, half, free.reshape(volume.shape)))
        if len(grids) == 1:
            half = frame
        elif not inside.any():
            break
        elif len(grids) == len(GRIDS):
            surface = (volume & ~binary_erosion(volume)).ravel()
            offsets = stream(SEED, "points of a hull").uniform(-1, 1, (surface.sum(), 3))
            points, colors = places[surface] + offsets * half / count, np.rint(found[surface]).astype(np.uint8)
        else:
            low, high = places[inside].min(axis=0), places[inside].max(axis=0)
            centre, half = (low + high) / 2, float((high - low).max() / 2 + 2 * half / count)
    return grids, points, colors


def plain_color(views: list[View]) -> Array | None:
    """Find the colour (3,) of the background, RGB from 0 to 1: that of most pixels on the photos' edges.

    None if there is no such colour, or if one of the four edges has too little of it, as with a sky above the ground.
    """
    edges: list[list[NDArray[np.uint8]]] = [[] for _ in EDGES]
    for view in in_turn(views):
        for found, edge in zip(edges, EDGES, strict=True):
            found.append(view.image[edge][view.counts[edge]])
    pixels = [np.concatenate(found) / 255 for found in edges]
    if not sum(map(len, pixels)):
        return None
    color = np.median(np.concatenate(pixels), axis=0)
    alike = [np.abs(each - color).max(axis=1) < TOLERANCE for each in pixels if len(each)]
    plain = np.concatenate(alike).mean() >= PLAIN and all(each.mean() >= PLAIN_EDGE for each in alike)
    return color if plain else None


def background(view: View, color: Array) -> NDArray[np.bool_]:
    """Find the pixels (H, W) of the background: those of its colour that are joined to the photo's edge."""
    from scipy.ndimage import label

    alike = np.ones(view.image.shape[:2], bool)
    for channel, value in enumerate(255 * color):
        alike &= np.abs(view.image[:, :, channel] - value) < 255 * TOLERANCE
    labels, _ = label(alike & view.counts)
    found = np.unique(labels[_rim(view)])
    return np.isin(labels, found[found > 0])


def _rim(view: View) -> NDArray[np.bool_]:
    """Pixels (H, W) on the edges of a photo that count."""
    rim = view.counts.copy()
    rim[1:-1, 1:-1] = False
    return rim


def _carved(points: Array, views: list[View], color: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Array]:
    """Whether points (P, 3) are inside the outlines, and outside of them, and their mean colours (P, 3), 0 to 255.

    Points that few photos show are neither.
    """
    shown, outside, sums = np.zeros(len(points), int), np.zeros(len(points), int), np.zeros((len(points), 3))
    left = np.arange(len(points))
    for view in in_turn(views):
        places, _, seen = projected(replace(view.camera, near=FLOAT32_TINY), points[left])
        column, row = places[seen].astype(int).T
        rows, behind = left[seen], background(view, color)[row, column]
        shown[rows] += 1
        outside[rows] += behind
        sums[rows] += np.where(behind[:, None], 0, view.image[row, column])
        left = left[outside[left] <= OUTSIDE * len(views)]  # no number of other photos would make up for more
    free = outside > OUTSIDE * shown
    inside = ~free & (shown >= max(FEWEST_PHOTOS, SHOWN * len(views)))
    return inside, free, sums / np.maximum(shown - outside, 1)[:, None]
