"""Codebooks: few numbers, or few rows of numbers, that stand for many."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

CODES = 256
"""Entries of a codebook of numbers: an index is a byte."""

BINS = 1 << 16
"""Of the histogram from which a codebook is laid."""

PALETTE_MAX = 1 << 16
"""Entries of a palette of rows: an index is two bytes."""

PALETTE_MIN = 1024
PALETTE_SHARE = 3
"""Rows that share an entry of the palette, on average, if there are more than PALETTE_MIN: a fifth of
the entries less saves 2 bytes of 24 for a Gaussian of degree 3 and loses 0.02 dB."""

TRAINING = 64
"""Rows per coarse cell that the cells' centres are found from."""

ITERATIONS = 4
"""Of Lloyd's algorithm: 8 and 16 change the PSNR of a trained scene by less than 0.01 dB."""


def codebook(values: Array) -> Array:
    """256 numbers, ascending, float32, that stand for all values; exactly where there are no more different ones.

    Half of them are laid evenly over the range, half as dense as the third root of the values' density, which makes
    the mean squared error least (Panter and Dite 1951, doi:10.1109/JRPROC.1951.230419); so no value within the range
    is further than 1/256 of it from an entry.
    """
    flat = np.asarray(values, np.float32).ravel()
    low, high = float(flat.min()), float(flat.max())
    few = np.unique(flat[:: max(1, len(flat) // (16 * CODES))])
    if len(few) <= CODES:
        few = np.unique(flat)
        if len(few) <= CODES:
            return np.concatenate([few, np.full(CODES - len(few), few[-1])])
    counts, edges = np.histogram(flat, BINS, (low, high))
    density = np.cbrt(counts)
    share = np.concatenate([[0.0], np.cumsum(density / density.sum() + 1 / BINS)]) / 2
    return np.interp((np.arange(CODES) + 0.5) / CODES, share, edges).astype(np.float32)


def nearest(book: Array, values: Array) -> Array:
    """Index of the entry nearest to each value, uint8, of the values' shape; `book` as of `codebook`."""
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2
    return np.searchsorted(middles, values).astype(np.uint8)


def palette(rows: Array, weights: Array) -> tuple[Array, Array]:
    """Rows (P, D), float32, that stand for all rows (N, D), and the index of the one for each, (N,) uint16.

    Two levels of weighted k-means: about sqrt(P) coarse cells, then as many entries in each cell as its share of the
    weights (N,) calls for. A row is compared with about 2 sqrt(P) entries instead of P, which bounds the time for a
    million.
    """
    n = len(rows)
    rows = np.ascontiguousarray(rows, np.float32)
    size = min(n, max(PALETTE_MIN, n // PALETTE_SHARE), PALETTE_MAX)
    if size == n:
        return rows, np.arange(n, dtype=np.uint16)
    count = round(size**0.5)
    step = max(1, n // (count * TRAINING))
    cells = _closest(rows, _means(rows[::step], weights[::step], count))
    order = np.argsort(cells, kind="stable")
    total = weights.sum(dtype=np.float64)
    entries: list[Array] = []
    labels = np.empty(n, np.uint16)
    begin = 0
    for members in np.split(order, np.flatnonzero(np.diff(cells[order])) + 1):
        mine = rows[members]
        share = weights[members].sum(dtype=np.float64) / total
        part = _means(mine, weights[members], max(1, int((size - count) * share)))
        labels[members] = begin + _closest(mine, part)
        entries.append(part)
        begin += len(part)
    return np.concatenate(entries), labels


def _means(rows: Array, weights: Array, count: int) -> Array:
    """Centres (at most count, D) of clusters by Lloyd's iterations from rows at equal distances in weight."""
    if count >= len(rows):
        return rows
    reached = np.cumsum(weights, dtype=np.float64)
    start = np.searchsorted(reached, (np.arange(count) + 0.5) / count * reached[-1])
    centres = rows[np.unique(np.minimum(start, len(rows) - 1))]
    for _ in range(ITERATIONS):
        labels = _closest(rows, centres)
        order = np.argsort(labels, kind="stable")
        firsts = np.flatnonzero(np.diff(labels[order], prepend=-1))
        mass = np.add.reduceat(weights[order], firsts)[:, None]
        sums = np.add.reduceat(rows[order] * weights[order, None], firsts, axis=0)
        centres[labels[order][firsts]] = sums / mass  # those of no row stay
    return centres


def _closest(rows: Array, centres: Array) -> Array:
    from scipy.cluster.vq import vq

    return vq(rows, centres, check_finite=False)[0]
