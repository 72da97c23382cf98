"""Weights of a scene's Gaussians in photos, by which blocks choose photos and share pixels."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.blocks.sight import Bounds, seen
from clsplat.constants import ALPHA_MIN
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.renderer import Pass, Renderer, download
from clsplat.scene import View, in_turn
from clsplat.training.contributions import weighted_sums

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Array = NDArray[np.float64]

COVERED = 0.95
"""Fraction of a block's weight, summed over all photos, that the photos of the block must show. The others show
little of it each."""


def weights(renderer: Renderer, gaussians: Gaussians, views: Iterable[View]) -> Iterator[Array]:
    """Sum the compositing weights alpha T of each Gaussian over the pixels of photos.

    Parameters
    ----------
    renderer : Renderer
    gaussians : Gaussians of N >= 1 rows
    views : iterable of View
        Pixels that their masks leave out do not count.

    Yields
    ------
    (N,) float64
        Per view, in pixels; 0 for what is not seen.
    """
    placed = renderer.place(gaussians)
    for view in views:
        yield _weights(renderer, renderer.forward(placed, view.camera), view.mask)


def _weights(renderer: Renderer, run: Pass, mask: NDArray[np.bool_] | None = None) -> Array:
    shape = run.camera.height, run.camera.width, 1
    return weighted_sums(renderer, run, np.ones(shape) if mask is None else mask.reshape(shape))[:, 0]


def survey(renderer: Renderer, gaussians: Gaussians, views: list[View]) -> "csr_array":
    """The weights of all Gaussians in all photos, without zeros.

    Parameters
    ----------
    renderer, gaussians, views
        As given to `weights`.

    Returns
    -------
    (V, N) sparse array of float32
        In pixels. A weight takes eight bytes. A photo shows a small part of a large scene.
    """
    from scipy.sparse import csr_array

    ends, columns, values = [0], [np.zeros(0, np.int32)], [np.zeros(0, np.float32)]
    for each in weights(renderer, gaussians, views):
        shown = np.flatnonzero(each > 0)
        columns.append(shown.astype(np.int32))
        values.append(each[shown].astype(np.float32))
        ends.append(ends[-1] + len(shown))
    return csr_array((np.concatenate(values), np.concatenate(columns), ends), (len(views), len(gaussians)))


def block_weights(surveyed: "csr_array", blocks: NDArray[np.intp], count: int) -> Array:
    """Sum the weights of the Gaussians of each block in each photo.

    Parameters
    ----------
    surveyed : (V, N) sparse array
        As `survey` returns it.
    blocks : (N,) int
        The block of each Gaussian, below `count`.

    Returns
    -------
    (V, count) float64
        In pixels.
    """
    from scipy.sparse import csr_array

    members = csr_array((np.ones(len(blocks)), blocks, np.arange(len(blocks) + 1)), (len(blocks), count))
    return np.asarray((surveyed @ members).toarray())


def shown_in(surveyed: "csr_array", photos: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether any of some photos shows each Gaussian, (N,)."""
    found = np.zeros(surveyed.shape[1], bool)
    found[surveyed[photos].indices] = True
    return found


def chosen_photos(shares: Array, fewest: int) -> NDArray[np.intp]:
    """Choose the photos of a block: those that show most of it, until they show `COVERED` of its whole weight.

    Parameters
    ----------
    shares : (V,)
        Weight of the block in each photo.
    fewest : int
        Number of photos that are chosen in any case, if there are as many.

    Returns
    -------
    (P,) int
        Indices of photos, ascending; at least one.
    """
    order = np.argsort(-shares, kind="stable")
    sums = np.cumsum(shares[order])
    count = int(np.searchsorted(sums, COVERED * sums[-1])) + 1
    return np.sort(order[: max(count, fewest)])


def seen_by_block(
    renderer: Renderer,
    gaussians: Gaussians,
    trains: NDArray[np.bool_],
    views: list[View],
    keep: Callable[[View], None] | None = None,
    most: int | None = None,
) -> tuple[list[View], NDArray[np.bool_]]:
    """Make the photos as a block should see them, and find the Gaussians that they show.

    Let C be the scene's image, P the photo, and m the block's share in the weights of a pixel. The image is
    linear in the weights, so the block's part in the difference P - C is m (P - C), and what the block trains on is
    C + m (P - C). Where only its surroundings are visible, it finds the image that they make, and no error to mend.

    Parameters
    ----------
    renderer : Renderer
    gaussians : Gaussians of N >= 1 rows
        The scene, on the host.
    trains : (N,) bool
        The Gaussians that the block trains.
    views : list of View
    keep : callable, optional
        Called with each view that is made, which is then not in the result: it may not fit the memory.
    most : int, optional
        Gaussians that fit the device. If there are more, those are placed that some of the views may show, then those
        of the next views. The result has the same bits.

    Returns
    -------
    views : list of View
        With these images.
    shown : (N,) bool
        The Gaussians that have a weight in any of them.
    """
    shown = np.zeros(len(gaussians), bool)
    result = []
    for some, rows in _batches(renderer, gaussians, views, len(gaussians) if most is None else most):
        placed = renderer.place(gaussians.take(rows))
        marks = renderer.upload("marks", np.repeat(trains[rows, None], 3, axis=1))
        for view in in_turn(some):
            run = renderer.forward(placed, view.camera)
            shown[rows[_weights(renderer, run, view.mask) > 0]] = True
            image = np.clip(download(run.image.rgb), 0, 1, dtype=np.float64)
            marked = renderer.recolored(run, marks)
            share = download(marked.rgb)[:, :, :1] / np.maximum(download(marked.alpha)[:, :, None], ALPHA_MIN)
            blended = image + np.clip(share, 0, 1) * (view.image / 255 - image)
            del run, marked  # the next image needs their memory
            made = replace(view, image=to_uint8(blended))
            result.append(made) if keep is None else keep(made)
        del placed, marks
    return result, shown


def _batches(
    renderer: Renderer, gaussians: Gaussians, views: list[View], most: int
) -> Iterator[tuple[list[View], NDArray[np.intp]]]:
    """Yield the views, some at a time, and the rows that these may show: at most `most`, or those of one view."""
    rows = np.arange(len(gaussians))
    if len(rows) > most:
        rows = np.flatnonzero(seen((view.camera for view in views), Bounds.of(gaussians), renderer.config))
    if len(rows) <= most or len(views) == 1:
        yield views, rows if len(rows) else np.arange(1)  # a scene has a row, also one that nobody sees
        return
    half = len(views) // 2
    yield from _batches(renderer, gaussians, views[:half], most)
    yield from _batches(renderer, gaussians, views[half:], most)
