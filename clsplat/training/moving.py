"""What moves while photos are taken, such as people who walk by: found in training photos, and left out of them.

The scene cannot show what only one photo has in a place. Training explains it by Gaussians in front of this photo's
camera, which other views show as haze. Sabour et al. 2023, "RobustNeRF: Ignoring distractors with robust losses",
leave out the neighbourhoods with the largest errors of a photo. Here an error counts only where the same Gaussians
have less of it in the other photos: what is hard to fit has errors in all of them. Measured:
docs/experiments/moving.md.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians
from clsplat.renderer import Pass, Renderer, download
from clsplat.scene import View, evenly_spaced, in_turn
from clsplat.training.coarse_to_fine import shrunk
from clsplat.training.contributions import weighted_sums

Array = NDArray[np.float64]
Masks = Mapping[str, NDArray[np.bool_]]

TIMES = (0.2, 0.3, 0.4, 0.6)
"""Fractions of the iterations after which photos are looked through. Each time decides anew, from all their pixels:
what seemed to move because it was not trained yet comes back."""

EARLIEST = 200
"""First iteration after which photos are looked through: before, the scene has learned too little."""

SAMPLE = 60
"""Most photos, evenly spaced, that decide whether anything moves; only then are all looked through."""

EDGE = 400
"""Longest edge of the reduced photos, px: people who matter are larger than the pixels of these."""

WINDOW = 1 / 32
"""Edge of the squares over which differences are averaged, in longer edges of the photo: at the edge of an object
that is a pixel off, their mean is near zero."""

SMALLEST = 8
"""Least edge of these squares, px: in tiny photos, the fraction would be a few pixels, which is no mean."""

SEED = 0.05
"""Least square of the mean difference at a seed, the centre of such a square, summed over RGB in [0, 1]: 33 of 255
levels in each channel."""

CONTRADICTED = 3.0
"""Least ratio of this square to the squared difference that the Gaussians of the pixel have in other photos."""

AROUND = 0.02
"""Least squared difference, summed over RGB, of the pixels around a seed that are left out with it."""

NEIGHBOURS = 3
"""Edge of the square over which the squared differences around a seed are averaged, px."""

OTHERS = 2.0
"""Number of other photos that must show the Gaussians of a pixel, on average, to contradict it."""

PART = 0.005
"""Fraction of a photo's pixels from which seeds are taken for something that moves."""

WHOLE = 0.5
"""Fraction of a photo's pixels beyond which its exposure or pose is wrong. Nothing is left out of it then, and it
does not count as evidence that something moves."""

LEAST = 0.004
"""Least fraction of all pixels that must be seeds: otherwise nothing is left out of any photo (where nothing moves:
docs/experiments/moving.md)."""

BROAD = 0.1
"""Largest extent of a splat, in longer edges of the photo, that is evidence for a seed. Where a scene has only
broader ones, it is not trained yet: other photos show them, but not at this place."""

SHOWN = 0.5
"""Sum of the compositing weights, in pixels of the reduced photos, from which a photo shows a Gaussian."""

MOST_OTHERS = 10
"""Largest number of other photos that counts for a Gaussian: many that show one must not make up for a pixel's other
Gaussians."""


class Evidence(NamedTuple):
    """What a photo and the others say about its pixels.

    differences (H, W, 3): the render less the photo; expected (H, W): the squared difference, summed over RGB, that
    the Gaussians of a pixel have in the other photos; others (H, W): the number of other photos that show them;
    narrow (H, W): the same of those whose splats are not `BROAD`, where the other Gaussians count as 0.
    """

    differences: Array
    expected: Array
    others: Array
    narrow: Array


def due(iteration: int, iterations: int, found: bool) -> bool:
    """Whether photos are looked through after an iteration; after the first time only if something was found."""
    times = [max(EARLIEST, round(time * iterations)) for time in TIMES]
    return iteration < iterations and iteration in (times if found else times[:1])


def moving(
    renderer: Renderer, gaussians: Gaussians, views: list[View], sh_degree: int
) -> dict[str, NDArray[np.bool_]]:
    """Find what moves in photos of a scene that is being trained.

    Parameters
    ----------
    renderer : Renderer
    gaussians : Gaussians
        As they are rendered, without those of the renderer's backdrop.
    views : list of View
        All training photos, with all pixels that may train.
    sh_degree : int
        Highest degree of the spherical harmonics evaluated.

    Returns
    -------
    dict of str to (H, W) bool
        Pixels that show what moves, by the name of the photo, which is reduced; without photos where nothing moves.
    """
    found = _moving(renderer, gaussians, evenly_spaced(views, SAMPLE), sh_degree)
    return found if not found or len(views) <= SAMPLE else _moving(renderer, gaussians, views, sh_degree)


def _moving(
    renderer: Renderer, gaussians: Gaussians, views: list[View], sh_degree: int
) -> dict[str, NDArray[np.bool_]]:
    parts, found = [], {}
    for view, evidence in zip(views, evidence_of(renderer, gaussians, views, sh_degree), strict=True):
        seeds = seeds_of(evidence)
        part = float(seeds.mean())
        if part <= WHOLE:
            parts.append(part)
        if PART <= part <= WHOLE:
            found[view.name] = grown(seeds, evidence)
    return found if parts and np.mean(parts) >= LEAST else {}


def evidence_of(renderer: Renderer, gaussians: Gaussians, views: list[View], sh_degree: int) -> Iterator[Evidence]:
    """Yield what each photo and the others say about its pixels; photos are reduced to `EDGE`.

    Parameters
    ----------
    renderer, gaussians, views, sh_degree
        As given to `moving`.

    Yields
    ------
    Evidence
        Per view.
    """
    placed, small = renderer.place(gaussians), [_small(view) for view in views]
    sums, shown = np.zeros((len(gaussians), 2)), np.zeros(len(gaussians))
    for view in in_turn(small):
        run = renderer.forward(placed, view.camera, sh_degree)
        part = _contributions(renderer, run, view.counts, _differences(run, view))
        sums, shown = sums + part, shown + (part[:, 0] > SHOWN)
    # The contributions of each photo are computed again: those of all photos to all Gaussians would fill the memory.
    for view in in_turn(small):
        run = renderer.forward(placed, view.camera, sh_degree)
        differences = _differences(run, view)
        own = _contributions(renderer, run, view.counts, differences)
        weights, errors = np.maximum(sums - own, 0).T
        colors = np.zeros((len(run.drawn.depths), 3))
        colors[: len(own), 0] = np.divide(errors, weights, out=np.zeros_like(errors), where=weights > 0)
        colors[: len(own), 1] = np.minimum(shown - (own[:, 0] > SHOWN), MOST_OTHERS)
        narrow = download(run.splats.extents).max(axis=1) <= BROAD * max(view.camera.width, view.camera.height)
        colors[: len(own), 2] = colors[: len(own), 1] * narrow
        image = download(renderer.recolored(run, renderer.upload("colors", colors)).rgb)
        yield Evidence(differences, *np.moveaxis(image, 2, 0))


def _small(view: View) -> View:
    return shrunk(view, max(1, -(-max(view.camera.width, view.camera.height) // EDGE)))


def _differences(run: Pass, view: View) -> Array:
    """The render less the photo (H, W, 3), 0 where pixels do not count."""
    return (download(run.image.rgb)[:, :, :3].astype(np.float64) - view.image / 255) * view.counts[:, :, None]


def _contributions(renderer: Renderer, run: Pass, counts: NDArray[np.bool_], differences: Array) -> Array:
    """Sums over pixels (N, 2) of each Gaussian's weight, and of its weight times the squared difference."""
    return weighted_sums(renderer, run, np.stack([counts, (differences**2).sum(axis=2)], axis=2))


def seeds_of(evidence: Evidence) -> NDArray[np.bool_]:
    """Pixels (H, W) around which a photo differs on average, and by more than its Gaussians do in other photos."""
    window = _window(evidence)
    square = (_mean(evidence.differences, window) ** 2).sum(axis=2)
    known = _mean(evidence.narrow, window) > OTHERS
    return known & (square > SEED) & (square > CONTRADICTED * _mean(evidence.expected, window))


def grown(seeds: NDArray[np.bool_], evidence: Evidence) -> NDArray[np.bool_]:
    """Seeds (H, W) with the pixels around them that differ too, gaps between these, and a rim of a pixel."""
    from scipy.ndimage import binary_closing, binary_dilation, binary_propagation

    window = _window(evidence)
    square = _mean((evidence.differences**2).sum(axis=2), NEIGHBOURS)
    known = _mean(evidence.others, window) > OTHERS
    differs = known & (square > AROUND) & (square > _mean(evidence.expected, window))
    part = np.pad(seeds | binary_propagation(seeds & differs, mask=differs), window)
    closed = part | binary_closing(part, iterations=max(1, window // 2))
    return np.asarray(binary_dilation(closed[window:-window, window:-window]))


def _window(evidence: Evidence) -> int:
    return max(SMALLEST, round(WINDOW * max(evidence.expected.shape)))


def _mean(values: Array, edge: int) -> Array:
    """Means over squares around each pixel."""
    from scipy.ndimage import uniform_filter

    return np.asarray(uniform_filter(values, (edge, edge, *[1] * (values.ndim - 2)), mode="nearest"))


def still(views: list[View], found: Masks) -> list[View]:
    """Views without the pixels that show what moves, as masks of reduced photos by name."""
    return [
        view.changed(partial(_without, moving=found[view.name]), masks=True) if view.name in found else view
        for view in views
    ]


def _without(view: View, moving: NDArray[np.bool_]) -> View:
    rows, columns = (np.arange(n) * m // n for n, m in zip(view.counts.shape, moving.shape, strict=True))
    counts = view.counts & ~moving[np.ix_(rows, columns)]
    if not counts.any():
        return view
    depth = view.depth and replace(view.depth, values=np.where(counts, view.depth.values, np.float32(np.nan)))
    return replace(view, mask=counts, depth=depth)
