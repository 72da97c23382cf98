"""Points between the sparse ones, where several photos agree on a depth: a denser start than features give.

Each photo is compared with its neighbours on planes of constant depth (stage sweep). A depth counts if the windows
are alike, and if the depths of other photos agree. Features leave gaps, where few large Gaussians would have to be
split many times; with a denser start, growth begins where surfaces are (Kotovenko et al. 2025, "EDGS", begin with
dense matches of a network). Measured: docs/experiments/strategies.md.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import TrainConfig
from clsplat.constants import SWEEP_PLANES
from clsplat.dataset.coverage import projected
from clsplat.randomness import stream
from clsplat.renderer import Renderer, download
from clsplat.scene import Scene, View, evenly_spaced, in_turn
from clsplat.training.autosize.rule import reach
from clsplat.training.coarse_to_fine import shrunk
from clsplat.training.memory import Footprint

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[Any]

SHARE = 0.5
"""Fraction of the Gaussians that growth may reach, up to which dense points are added. Growth adds the others where
the errors of the photos are."""

EDGE = 240
"""Longer edge to which photos are reduced, px."""

LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in a grey value (ITU-R BT.601)."""

PLANES = 96
"""Number of planes, equally spaced in inverse depth."""

SOURCES = 5
"""Number of photos with which each is compared."""

MOST_PHOTOS = 100
"""Largest number of photos that are compared, evenly spaced, which bounds the time."""

BYTES = 4 * (PLANES + 2 * SOURCES * SWEEP_PLANES + MOST_PHOTOS)
"""Bytes of the device's memory per pixel, in single precision: scores of all planes, sources with margins on a few of
them, and all photos."""

ANGLE = 8.0
"""Best angle between the directions to a point from two photos, degrees: smaller ones tell little of the depth, at
larger ones windows look different (Yao et al. 2018, "MVSNet", has a similar rule)."""

NARROWER, WIDER = 4.0, 12.0
"""Standard deviations of the weight of angles below and above `ANGLE`, degrees."""

COMMON = 20
"""Fewest sparse points that both photos of a pair show."""

MOST_ANGLES = 500
"""Most points of a pair whose angles are measured: enough for their median."""

SCORE = 0.6
"""Least score of a depth that becomes a point."""

SUPPORT = 0.4
"""Least score of a depth that supports that of another photo."""

AGREEMENT = 0.01
"""Largest relative difference of depths that agree."""

SUPPORTERS = 2
"""Fewest photos whose depths agree with that of a point."""

DEPTHS = 1, 99
"""Percentiles of the depths of the sparse points between which planes lie."""

NEARER, FARTHER = 0.8, 1.3
"""Factors on these depths: surfaces reach beyond the sparse points."""

BISECTIONS = 14
"""Steps in which `thinned` finds the size of its cells: to a thousandth of their logarithm."""

HASH = np.array([-0x61C8864680B583EB, -0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15, 1])
"""Factors of a cell's level and position, whose sum modulo 2^64 stands for the cell: three of the constants that
Steele et al. 2014, "Fast splittable pseudorandom number generators", multiply with, as signed integers."""


@dataclass(frozen=True)
class Depths:
    """Depths (H, W) of a photo, world units, and their scores (H, W)."""

    depth: Array
    score: Array


def first_points(scene: Scene, config: TrainConfig, device: "Device") -> Scene:
    """The scene with the points from which a training starts: dense ones, if the configuration asks for them.

    They are left out where the memory of the device does not allow them.
    """
    wanted = round(SHARE * reach(scene, config))
    if config.max_gaussians is not None:
        wanted = min(wanted, round(SHARE * config.max_gaussians))
    wanted = min(wanted, Footprint.of(scene, config, device).most_gaussians(device.memory_limit))
    if not config.init.dense or BYTES * EDGE**2 > device.memory_limit:
        return scene
    return with_dense_points(scene, Renderer(device), wanted, config.seed)


def with_dense_points(scene: Scene, renderer: Renderer, most: int, seed: int) -> Scene:
    """Add points on surfaces where several photos agree.

    Parameters
    ----------
    scene : Scene
    renderer : Renderer
        Its stages compare the photos.
    most : int
        Largest number of points afterwards. If the scene has as many, it is returned as it is.
    seed : int
        Seed of the choice among too many points.

    Returns
    -------
    Scene
        With the sparse points first. Photos that are neither pinhole nor large enough add none, and neither does a
        scene without sparse points, which tell at what depths to search.
    """
    wanted = most - len(scene.points)
    usable = [view for view in scene.train if view.camera.model == "pinhole"]
    if wanted <= 0 or len(usable) < SUPPORTERS + 1 or not len(scene.points):
        return scene
    photos = [small(view) for view in in_turn(evenly_spaced(usable, MOST_PHOTOS))]
    sources = neighbours([photo.camera for photo in photos], scene.points)
    greys = [renderer.upload("photo to sweep", photo.image @ LUMA / 255) for photo in photos]
    maps = [depths_of(i, photos, sources[i], greys, scene.points, renderer) for i in range(len(photos))]
    found = [agreed(i, photos, sources[i], maps) for i in range(len(photos))]
    points, colors, sizes = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    rows = thinned(points, sizes, wanted, seed)
    return replace(
        scene,
        points=np.concatenate([scene.points, points[rows]]),
        colors=np.concatenate([scene.colors, colors[rows]]),
    )


def small(view: View) -> View:
    """Reduce a photo to `EDGE` pixels. What a mask hides becomes black, so that it shows in no window."""
    if view.mask is not None:
        view = replace(view, image=np.where(view.mask[:, :, None], view.image, np.uint8(0)))
    return shrunk(view.with_depth(None), max(1.0, max(view.camera.width, view.camera.height) / EDGE))


def neighbours(cameras: list[Camera], points: Array) -> list[list[int]]:
    """Up to `SOURCES` photos for each, which have many of its points in their frame, seen at a good angle."""
    seen = np.array([projected(camera, points)[2] for camera in cameras])
    towards = np.array([points - camera.position for camera in cameras])
    towards /= np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-12)
    weights = np.zeros((len(cameras), len(cameras)))
    for i, j in combinations(range(len(cameras)), 2):
        both = np.flatnonzero(seen[i] & seen[j])
        if len(both) >= COMMON:
            some = both[:: -(-len(both) // MOST_ANGLES)]
            cosines = (towards[i, some] * towards[j, some]).sum(axis=1)
            angle = np.degrees(np.median(np.arccos(np.clip(cosines, -1, 1))))
            spread = NARROWER if angle < ANGLE else WIDER
            weights[i, j] = weights[j, i] = len(both) * np.exp(-0.5 * ((angle - ANGLE) / spread) ** 2)
    orders = np.argsort(-weights, axis=1, kind="stable")[:, :SOURCES]
    return [[int(j) for j in order if row[j] > 0] for row, order in zip(weights, orders, strict=True)]


def depths_of(
    i: int, photos: list[View], sources: list[int], greys: list[Any], points: Array, renderer: Renderer
) -> Depths:
    """Depths of photo `i`, by comparison with its sources. `greys` are the photos' grey values on the device."""
    camera = photos[i].camera
    _, depths, inside = projected(camera, points)
    if len(sources) < SUPPORTERS:  # otherwise the photo has points in its frame
        shape = camera.height, camera.width
        return Depths(np.ones(shape), np.full(shape, -1.0))
    nearest, farthest = np.percentile(depths[inside], DEPTHS)
    planes = renderer.upload("planes", np.linspace(1 / (FARTHER * farthest), 1 / (NEARER * nearest), PLANES))
    maps = renderer.upload("maps", np.array([between(camera, photos[s].camera) for s in sources]))
    compared = renderer.stages.sweep_scores(greys[i], [greys[s] for s in sources], maps, planes)
    inverse, scores = map(download, renderer.stages.sweep_best(compared, planes))
    mask = photos[i].mask
    return Depths(1 / inverse.astype(np.float64), scores if mask is None else np.where(mask, scores, -1))


def between(camera: Camera, other: Camera) -> Array:
    """The twelve numbers that take a pixel of a camera and an inverse depth to the other photo (stage sweep)."""
    motion = other.viewmat @ np.linalg.inv(camera.viewmat)
    a = other.K @ motion[:3, :3] @ np.linalg.inv(camera.K)
    return np.concatenate([a.ravel(), other.K @ motion[:3, 3]])


def agreed(i: int, photos: list[View], sources: Iterable[int], maps: list[Depths]) -> tuple[Array, Array, Array]:
    """Points of photo `i` with whose depth those of other photos agree, their colours, and the size of a pixel at
    each, world units."""
    camera = photos[i].camera
    rows, columns = np.nonzero(maps[i].score > SCORE)
    depth, rays = maps[i].depth[rows, columns], camera.rays(columns + 0.5, rows + 0.5)
    points = (rays / rays[:, 2:] * depth[:, None] - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    supporters = np.zeros(len(points), int)
    for j in sources:
        places, depths, inside = projected(photos[j].camera, points)
        column, row = places[inside].astype(int).T
        alike = np.abs(maps[j].depth[row, column] - depths[inside]) < AGREEMENT * depths[inside]
        supporters[inside] += alike & (maps[j].score[row, column] > SUPPORT)
    kept = supporters >= SUPPORTERS
    return points[kept], photos[i].image[rows, columns][kept], depth[kept] / camera.fx


def thinned(points: Array, sizes: Array, most: int, seed: int) -> NDArray[np.intp]:
    """Choose up to `most` points: one of each cell of a grid whose cells are proportional to the points' `sizes`."""
    order = stream(seed, "dense points").permutation(len(points))
    if len(points) <= most:
        return np.sort(order)

    widths, places = np.log2(sizes[order]), points[order]

    def cells(factor: float) -> NDArray[np.int64]:
        # Cells of powers of two, so that neighbours of similar size share a grid.
        levels = np.round(factor + widths).astype(np.int64)
        return np.column_stack([levels, np.floor(np.ldexp(places, -levels[:, None])).astype(np.int64)]) @ HASH

    low, high = 0.0, np.log2(np.ptp(points, axis=0).max() / sizes.min()) + 1  # of cells over sizes, as logarithms
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        count = 1 + np.count_nonzero(np.diff(np.sort(cells(middle))))
        low, high = (middle, high) if count > most else (low, middle)
    _, first = np.unique(cells(high), return_index=True)
    return np.sort(order[first])[:most]
