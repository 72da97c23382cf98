"""Brightness of photos compared with those taken next to them, and its correction before a training.

A camera with automatic exposure changes the brightness from photo to photo. Colours that depend on the direction of
view can follow what changes slowly along its path, and photos between others are then predicted by it. They cannot
follow what jumps from one photo to the next: training explains that by haze. Only the jumps are removed.

The brightness of a photo is that of the scene's points in it, compared with the same points in other photos, as the
photos of a panorama are evened out (Brown and Lowe 2007, "Automatic panoramic image stitching using invariant
features", section 6). The slow part is a Gaussian process over the positions of the cameras, and the jumps are its
noise (Rasmussen and Williams 2006, "Gaussian processes for machine learning", sections 2.2, 2.7, 4.2 and 5.4).
Measured: docs/experiments/strategies.md.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.dataset.coverage import projected
from clsplat.scene import Scene, View, in_turn

Array = NDArray[np.float64]

FEWEST_PHOTOS = 8
"""Fewest photos that are compared: with fewer, what is slow and what jumps cannot be told apart."""

MOST_PHOTOS = 300
"""Largest number of photos by which the Gaussian process is fitted, evenly spaced, which bounds the time."""

FEWEST_POINTS = 100
"""Fewest points by which the brightness of a photo is known to a hundredth: the logarithms of a point's colours in
several photos differ by 0.05 to 0.1."""

WINDOW = 2
"""Half edge of the square of pixels whose mean is a point's colour, px: points are off by up to a pixel."""

DARKEST, BRIGHTEST = 12, 243
"""Range of the colours that are compared, of 255: beyond, a photo is clipped, or its noise is larger."""

CLIPPED = 254
"""Value from which a channel counts as clipped: the scene may be brighter there, so that it is not made darker."""

ROUNDS = 20
"""Rounds of the robust fit."""

PRIOR = 0.3
"""Standard deviation of the logarithm of a photo's brightness before it is measured: some tenths in photos with
automatic exposure. It decides where a photo shares no points with others."""

LENGTHS = tuple(2.0 ** (k / 2) for k in range(4, 15))
"""Lengths over which the slow part may change, in median distances to the nearest camera. Shorter ones would follow
the jumps; over longer ones nothing changes."""

RATIOS = (0.0, *(2.0 ** (k / 2) for k in range(-12, 9)))
"""Standard deviations of the jumps that are compared, as factors on that of the slow part."""

SMALL = 1e-9
"""Added to the variances, as a fraction, so that places of photos that nearly agree can be told apart."""

LEAST = 0.015
"""Least root mean square of the logarithms of all factors with which photos are evened out: reflections change the
brightness of points, too. The photos of fern, whose exposure was fixed, seem to jump by 0.009."""


def gains(scene: Scene) -> dict[str, Array]:
    """Find how much brighter the training photos of a scene are than those taken nearby.

    Parameters
    ----------
    scene : Scene
        With points, and the photos that show each of them.

    Returns
    -------
    dict of str to (3,) float64
        Factors on the colours of photos, RGB from 0 to 255, by name. Empty if the photos hardly differ (`LEAST`), or
        are too few; without those that show too few points.
    """
    if len(scene.shown) < FEWEST_PHOTOS:
        return {}
    photos, points, colors = _colors(scene)
    known = np.bincount(photos, minlength=len(scene.train)) >= FEWEST_POINTS
    if known.sum() < FEWEST_PHOTOS:
        return {}
    logs = _brightness(photos, points, colors, len(scene.train))
    places = np.array([view.camera.position for view in scene.train])
    logs[known] = jumps(logs[known], places[known])
    if np.sqrt(np.mean(logs[known] ** 2)) < LEAST:
        return {}
    return {scene.train[k].name: np.exp(logs[k]) for k in np.flatnonzero(known)}


def evened(scene: Scene) -> Scene:
    """The scene with its training photos divided by their factors (`Scene.gains`)."""
    return replace(scene, train=even(scene.train, scene.gains), gains={})


def even(views: list[View], factors: Mapping[str, ArrayLike]) -> list[View]:
    """Views divided by their factors, by name; those without a factor stay as they are."""
    return [divided(view, factors[view.name]) if view.name in factors else view for view in views]


def divided(view: View, factor: ArrayLike) -> View:
    """A view with its colours divided by a factor for each channel; those that are clipped do not become darker."""
    values = np.arange(256)[:, None] / np.asarray(factor)
    values[CLIPPED:] = np.maximum(values[CLIPPED:], np.arange(CLIPPED, 256)[:, None])
    return view.changed(partial(_looked_up, table=np.rint(np.minimum(values, 255)).astype(np.uint8)))


def _looked_up(view: View, table: NDArray[np.uint8]) -> View:
    """The view with other values (256, 3) of its channels."""
    return replace(view, image=np.stack([table[view.image[:, :, c], c] for c in range(3)], axis=2))


def _colors(scene: Scene) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Colours of points that several photos show: indices of photo and point (N,), and logarithms (N, 3)."""
    around = np.arange(-WINDOW, WINDOW + 1)
    photos, points, logs = [], [], []
    for k, view in enumerate(in_turn(scene.train)):
        rows = scene.shown.get(view.name, np.zeros(0, np.intp))
        places, _, inside = projected(view.camera, scene.points[rows])
        column, row = places[inside].astype(int).T
        columns = np.clip(column[:, None, None] + around, 0, view.camera.width - 1)
        lines = np.clip(row[:, None, None] + around[:, None], 0, view.camera.height - 1)
        means = view.image[lines, columns].mean(axis=(1, 2))
        usable = ((means >= DARKEST) & (means <= BRIGHTEST)).all(axis=1) & view.counts[row, column]
        photos.append(np.full(usable.sum(), k))
        points.append(rows[inside][usable])
        logs.append(np.log(means[usable]))
    photo, point, colors = np.concatenate(photos), np.concatenate(points), np.concatenate(logs)
    several = np.bincount(point)[point] > 1
    return photo[several], np.unique(point[several], return_inverse=True)[1], colors[several]


def _brightness(photos: NDArray[np.intp], points: NDArray[np.intp], colors: Array, count: int) -> Array:
    """Logarithms (count, 3) of the brightness of photos, by least squares with the weights of Cauchy.

    A colour is the sum of a point's and a photo's. Reflections, and edges between two colours, do not fit.
    """
    from scipy.sparse import csr_matrix

    weights, scale, found = np.ones(len(photos)), 1.0, np.zeros((count, 3))
    for _ in range(ROUNDS):
        totals = np.bincount(points, weights)
        shares = csr_matrix((weights / totals[points], (photos, points)), (count, len(totals)))
        seen = csr_matrix((weights, (photos, points)), (count, len(totals)))
        sums = np.stack([np.bincount(points, weights * channel) for channel in colors.T], axis=1)
        own = np.stack([np.bincount(photos, weights * channel, count) for channel in colors.T], axis=1)
        normal = np.diag(np.bincount(photos, weights, count) + (scale / PRIOR) ** 2) - (shares @ seen.T).toarray()
        found = np.linalg.solve(normal, own - shares @ sums)
        errors = colors - found[photos]
        means = np.stack([np.bincount(points, weights * channel) for channel in errors.T], axis=1)
        errors = np.abs(errors - (means / totals[:, None])[points]).max(axis=1)
        scale = max(1.48 * float(np.median(errors)), SMALL)
        weights = 1 / (1 + (errors / (2 * scale)) ** 2)
    return found


def jumps(logs: Array, places: Array) -> Array:
    """The part of values (V, K) at places (V, 3) that changes from one to the next: the noise of a Gaussian process.

    Its mean is not known, its covariance is Matern's of order 3/2, and its length and noise are the most likely ones
    for the means of the channels. The result is 0 if half of the places are those of others, as those of the faces of
    panoramas are.
    """
    from scipy.spatial import cKDTree
    from scipy.spatial.distance import cdist

    nearest = float(np.median(cKDTree(places).query(places, 2)[0][:, 1]))
    if not nearest:
        return np.zeros_like(logs)
    chosen = np.linspace(0, len(places) - 1, min(len(places), MOST_PHOTOS)).round().astype(int)
    distances = cdist(places, places) / nearest

    def whitened(length: float, ratio: float, rows: NDArray[np.intp], values: Array) -> tuple[Array, Array, float]:
        """Values (V, K) less their mean, by the root of the covariance; this root; and how well it tells the mean."""
        scaled = np.sqrt(3) * distances[np.ix_(rows, rows)] / length
        root = np.linalg.cholesky((1 + scaled) * np.exp(-scaled) + (ratio**2 + SMALL) * np.eye(len(rows)))
        both = np.linalg.solve(root, np.column_stack([np.ones(len(rows)), values]))
        ones, rest = both[:, 0], both[:, 1:]
        return rest - np.outer(ones, ones @ rest) / (ones @ ones), root, float(np.log(ones @ ones))

    def cost(numbers: tuple[float, float]) -> float:
        """The negative logarithm of the likelihood, with the most likely size of the slow part and any mean."""
        rest, root, known = whitened(*numbers, chosen, logs[chosen].mean(axis=1))
        size = max(float((rest**2).sum()), SMALL**2)
        return float((len(chosen) - 1) / 2 * np.log(size) + np.log(np.diag(root)).sum() + known / 2)

    length, ratio = min(product(LENGTHS, RATIOS), key=cost)
    rest, root, _ = whitened(length, ratio, np.arange(len(places)), logs)
    return np.asarray(ratio**2 * np.linalg.solve(root.T, rest))
