"""Gaussians of the sky: far behind the scene, where photos show a smooth region above it, or a plain background.

Features find no points in the sky. Without Gaussians there, training explains it by large ones in the air before the
scene, where other views see them as haze. The sky box of Kerbl et al. 2024, "A hierarchical 3D Gaussian
representation", is a similar start. Measured: docs/experiments/strategies.md.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.dataset.coverage import projected
from clsplat.dataset.outlines import Grid, background, free_space, in_free_space, plain_color
from clsplat.gaussians import Gaussians
from clsplat.scene import Scene, View, evenly_spaced, in_turn
from clsplat.training.dense_start import MOST_PHOTOS
from clsplat.training.densify import STRATEGIES
from clsplat.training.initialize import from_points

Array = NDArray[np.float64]

DISTANCE = 30.0
"""Distance of the sky from the middle of the cameras, in extents of the scene. Two cameras see it in directions that
differ by a few degrees at most; larger distances gained nothing."""

BEYOND = DISTANCE / 2
"""Distance from which dropout keeps Gaussians, in extents of the scene: half of that of the sky."""

REACH = 3.0
"""Least distance of the sky as a factor on that of the points (`FARTHEST`)."""

FARTHEST = 0.99
"""Quantile of the distances of the points within which the scene lies."""

SPACING = 0.06
"""Angle between neighbouring Gaussians of the sky, radians. Growth divides them where the sky has detail."""

SIZE = 0.8
"""Standard deviation of a Gaussian of the sky, in distances to its neighbours: they leave no gaps."""

OPACITY = 0.99
"""Opacity of a Gaussian of the sky: what shines through would be explained by others, before the scene."""

CELL = 0.02
"""Edge of the cells of a photo that are sky or not, in diagonals of the photo."""

CELL_MIN = 4
"""Smallest edge of a cell, px: fewer pixels do not show whether it is smooth."""

TEXTURE = 0.05
"""Largest standard deviation of the grey values of a cell of the sky, from 0 to 1: clouds have less, leaves more."""

BELOW = 0.05
"""Sine of the angle to which the sky reaches below the horizon, which is known to some degrees only."""

UPRIGHT = 0.7
"""Least length of the mean of the cameras' up vectors with which the photos have a common horizon."""

ROLL = 0.01
"""Weight of the mean of the up vectors in the estimate of the vertical. It decides where the horizontal axes of the
cameras leave the vertical open, as they do if all look into one direction."""

UNSEEN = 0.5
"""Angle from the sky that photos show to which it continues where no photo looks, radians."""

AGREED = 0.045
"""Least solid angle, steradians, that at least two photos show as sky, if splats are left out at random. Those of the
sky never are: a false sky would take the place of the wall that a photo takes for it (measured:
docs/experiments/strategies.md)."""

ON_BACKGROUND = 0.1
"""Largest fraction of the points that may lie before a plain background, as wrong ones do, and those that are added
between the points of thin objects (measured: docs/experiments/strategies.md)."""

DIFFERENCE = 0.02
"""Largest difference of a colour from the background's, from 0 to 1, with which the background is the sky."""


def with_sky(gaussians: Gaussians, scene: Scene, config: TrainConfig, plain: bool = False) -> Gaussians:
    """Add Gaussians of the sky to the first ones of a training, if the configuration asks for them.

    Where there may be no more than `config.max_gaussians`, they replace others, evenly spaced. They are at most half:
    with fewer points the sky would be most of the scene.

    Parameters
    ----------
    gaussians : Gaussians
        Those of `initialize`, float32, on the host.
    scene : Scene
        Its training photos show the sky, and its points tell what is not sky.
    config : TrainConfig
    plain : bool
        Whether the background is plain, as `empty_space` tells.

    Returns
    -------
    Gaussians
        The first ones, and those of the sky behind them. The same object if there is no sky: photos without a smooth
        region above the horizon or without a common horizon, a scene without or with few points.
    """
    if not may_have_sky(scene, config):
        return gaussians
    sky = sky_gaussians(scene, config, plain)
    if sky is None:
        return gaussians
    both = len(gaussians) + len(sky)
    most = both if config.max_gaussians is None else min(both, config.max_gaussians)
    if 2 * len(sky) > most:
        return gaussians
    rows = np.linspace(0, len(gaussians) - 1, most - len(sky)).round().astype(int)
    return Gaussians.concatenate([gaussians.take(rows), sky])


def may_have_sky(scene: Scene, config: TrainConfig) -> bool:
    """Whether a training looks for the sky."""
    return config.init.sky and len(scene.points) > 0


def empty_space(scene: Scene, config: TrainConfig) -> list[Grid]:
    """Grids of the space before a plain background (`clsplat.dataset.outlines`) that a training keeps free.

    None if the configuration has no sky or a strategy that leaves no room, or if there are points in it: what looks
    like a background is then a surface, such as the wall of a room.
    """
    if not may_have_sky(scene, config) or not STRATEGIES[config.strategy].leaves_room:
        return []
    grids = free_space(scene.train)
    return grids if grids and in_free_space(scene.points, grids).mean() <= ON_BACKGROUND else []


def beyond(gaussians: Gaussians, scene: Scene) -> NDArray[np.bool_]:
    """Tell which Gaussians are at least half as far away as the sky: no part of the scene is behind them."""
    centre, distance = _around(scene)
    return np.asarray(np.linalg.norm(gaussians.means - centre, axis=1) > distance / 2)


def _around(scene: Scene) -> tuple[Array, float]:
    """Centre (3,) and radius of the sphere of the sky of a scene with points, world units."""
    centre = np.mean([view.camera.position for view in scene.train], axis=0)
    reach = REACH * float(np.quantile(np.linalg.norm(scene.points - centre, axis=1), FARTHEST))
    return centre, max(DISTANCE * scene.extent, reach)


def sky_gaussians(scene: Scene, config: TrainConfig, plain: bool = False) -> Gaussians | None:
    """Make the Gaussians of the sky; None if the photos show no sky.

    They lie on a sphere around the cameras, in all directions that are sky in each photo that looks there, of at most
    `MOST_PHOTOS`, and in directions nearby into which no photo looks. If splats are left out at random, there is no
    sky unless photos agree on enough of it. A plain background is sky below the horizon, too.
    """
    from scipy.spatial import cKDTree

    views = evenly_spaced(scene.train, MOST_PHOTOS)
    color = plain_color(views) if plain else None
    up = vertical([view.camera for view in scene.train]) if color is None else None
    if up is None and color is None:
        return None
    directions = sphere(round(4 * np.pi / SPACING**2))
    centre, distance = _around(scene)
    means = centre + distance * directions
    colors, shown, as_sky = np.zeros_like(means), np.zeros(len(means), int), np.zeros(len(means), int)
    for view in in_turn(views):
        cells, averages, edge = sky_cells(view, scene.points, up, color)
        places, _, inside = projected(view.camera, means)
        rows = np.flatnonzero(inside)
        column, row = (places[rows] // edge).astype(int).T
        shown[rows] += _whole_cells(view.counts, edge)[row, column]  # masks hide what is there
        sky = cells[row, column]
        as_sky[rows[sky]] += 1
        colors[rows[sky]] += averages[row[sky], column[sky]]
    kept = (as_sky > 0) & (as_sky == shown)
    if up is not None and config.dropout and SPACING**2 * (kept & (shown > 1)).sum() < AGREED:
        return None
    colors[kept] /= as_sky[kept, None]
    kept &= np.abs(colors - BACKGROUNDS[config.data.background]).max(axis=1) > DIFFERENCE
    if not kept.any():
        return None
    away, nearest = cKDTree(directions[kept]).query(directions)
    unseen = (shown == 0) & (away < UNSEEN)
    if up is not None:
        unseen &= directions @ up > 0
    colors[unseen] = colors[kept][nearest[unseen]]
    chosen = kept | unseen
    init = replace(config.init, opacity=OPACITY)
    sky = from_points(means[chosen], np.rint(255 * colors[chosen]).astype(np.uint8), init)
    return replace(sky, log_scales=np.full_like(sky.log_scales, np.log(SIZE * SPACING * distance)))


def sphere(count: int) -> Array:
    """Unit vectors (count, 3), evenly distributed: a spiral of equal areas, turned by the golden angle."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1)


def vertical(cameras: list[Camera]) -> Array | None:
    """Find the direction up (3,), a unit vector: as orthogonal as possible to the horizontal axes of the cameras.

    None where the cameras have no common horizon, as those of a drone that looks down while it turns.
    """
    rows = np.array([camera.viewmat[:2, :3] for camera in cameras])
    mean = -rows[:, 1].mean(axis=0)
    if np.linalg.norm(mean) < UPRIGHT:
        return None
    matrix = rows[:, 0].T @ rows[:, 0] / len(cameras) - ROLL * np.outer(mean, mean)
    up = np.asarray(np.linalg.eigh(matrix)[1][:, 0], dtype=np.float64)
    return up if up @ mean > 0 else -up


def sky_cells(
    view: View, points: Array, up: Array | None, color: Array | None = None
) -> tuple[NDArray[np.bool_], Array, int]:
    """Find the square cells of a photo that show the sky: smooth, without points, and joined to the photo's edge.

    Parameters
    ----------
    view : View
        With its arrays in memory.
    points : (P, 3)
        In world units.
    up : (3,), optional
        Unit vector, world. Without it, cells are those of a plain background.
    color : (3,), optional
        Colour of the plain background, RGB from 0 to 1.

    Returns
    -------
    cells : (R, C) bool
    averages : (R, C, 3)
        Mean colours of the cells, RGB from 0 to 1.
    edge : int
        Edge of the cells, px; the last row and column may lack pixels.
    """
    from scipy.ndimage import label

    camera = view.camera
    edge = max(CELL_MIN, round(CELL * float(np.hypot(camera.width, camera.height))))
    rows, columns = -(-camera.height // edge), -(-camera.width // edge)
    padding = (0, rows * edge - camera.height), (0, columns * edge - camera.width)
    image = np.pad(view.image, (*padding, (0, 0)), mode="edge")
    averages = _cell_sums(image, edge) / (255 * edge**2)
    grey = image[:, :, :1] + image[:, :, 1:2].astype(np.int64) + image[:, :, 2:]
    sums, squares = (_cell_sums(values, edge)[:, :, 0] for values in (grey, grey**2))
    deviation = np.sqrt(edge**2 * squares - sums**2) / (3 * 255 * edge**2)
    counts = view.counts if view.clear is None else view.counts & (view.clear == 0)
    if color is not None:
        counts = counts & background(view, color)
    whole = _whole_cells(counts, edge)

    places, _, inside = projected(camera, points)
    empty = np.ones((rows, columns), bool)
    column, row = (places[inside] // edge).astype(int).T
    empty[row, column] = False
    if up is None:
        return whole & empty, averages, edge
    x, y = np.meshgrid(edge * (np.arange(columns) + 0.5), edge * (np.arange(rows) + 0.5))
    sines = camera.rays(x, y) @ (camera.viewmat[:3, :3] @ up)  # NaN where a fisheye sees nothing

    free = (deviation < TEXTURE) & whole & empty & (sines > -BELOW)
    rim = free & (sines > BELOW)
    rim[1:-1, 1:-1] = False
    labels, _ = label(free)
    return np.isin(labels, np.unique(labels[rim])) & free, averages, edge


def _whole_cells(counts: NDArray[np.bool_], edge: int) -> NDArray[np.bool_]:
    """Whether all pixels of each square cell count, (R, C), of those of a photo, (H, W)."""
    rows, columns = (-(-size // edge) for size in counts.shape)
    padding = (0, rows * edge - counts.shape[0]), (0, columns * edge - counts.shape[1])
    return np.asarray(np.pad(counts, padding, mode="edge").reshape(rows, edge, columns, edge).all(axis=(1, 3)))


def _cell_sums(values: NDArray[Any], edge: int) -> NDArray[np.int64]:
    """Sums (R, C, K) over the square cells of integers (R edge, C edge, K)."""
    rows = len(values) // edge
    strips = values.reshape(rows, edge, -1).sum(axis=1, dtype=np.int64)
    return strips.reshape(rows, -1, edge, values.shape[2]).sum(axis=2)
