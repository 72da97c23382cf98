"""Codebooks: a few numbers, or a few rows of numbers, that approximate many."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

CODES = 256
"""Number of entries in a codebook of numbers, so that an index is one byte."""

BINS = 1 << 16
"""Number of bins of the histogram from which a codebook is computed."""

PALETTE_MAX = 1 << 16
"""Largest number of entries in a palette of rows, so that an index is two bytes."""

PALETTE_MIN = 1024
"""Number of rows up to which each row has its own entry in the palette."""

PALETTE_SHARE = 3
"""Mean number of rows per entry of the palette, for more than PALETTE_MIN rows. Measurement: docs/formats.md."""

TRAINING = 64
"""Number of rows per coarse cell from which the centres of the cells are computed."""

ITERATIONS = 4
"""Number of iterations of Lloyd's algorithm. Measurement: docs/formats.md."""


def codebook(values: Array) -> Array:
    """Compute 256 numbers, ascending, float32, that approximate all values; exact for up to 256 different values.

    Half of the entries are spaced evenly over the range of the values. The density of the other half is proportional
    to the third root of the density of the values, which minimises the mean squared error (Panter and Dite 1951,
    doi:10.1109/JRPROC.1951.230419). Hence each value is at most 1/256 of the range away from an entry.
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
    """Find the index of the entry of a `codebook` nearest to each value, uint8, in the shape of `values`."""
    middles = (book[1:].astype(np.float64) + book[:-1]) / 2
    return np.searchsorted(middles, values).astype(np.uint8)


def shared_rows(rows: Array, most: int) -> tuple[Array, Array] | None:
    """Find the different rows of (N, D), and the index of each row's own, if there are at most `most`.

    Returns
    -------
    tuple or None
        Different rows (P, D), in the order of their first appearance, and labels (N,); None if there are more.
    """
    # Rows with equal sums of their columns, multiplied by irregular factors, are equal, except for rare coincidences.
    factors = np.sqrt(np.arange(2, rows.shape[1] + 2, dtype=np.float64))
    _, first, labels = np.unique(rows @ factors, return_index=True, return_inverse=True)
    if len(first) > most:
        return None
    appearance = np.argsort(first, kind="stable")
    entries, labels = rows[first[appearance]], np.argsort(appearance)[labels]
    return (entries, labels) if np.array_equal(entries[labels], rows) else None


def palette(rows: Array, weights: Array) -> tuple[Array, Array]:
    """Compute rows that approximate all rows, by weighted k-means on two levels.

    There are about sqrt(P) coarse cells. The number of entries in a cell is proportional to its share of the weights.
    A row is compared with about 2 sqrt(P) entries instead of P, which bounds the time for a million rows. Rows of
    which few are different are kept as they are.

    Parameters
    ----------
    rows : (N, D)
        The rows to approximate.
    weights : (N,)
        Weights of their squared errors, positive.

    Returns
    -------
    entries : (P, D) float32
        The palette.
    labels : (N,) uint16
        Index of the entry of each row.
    """
    n = len(rows)
    rows = np.ascontiguousarray(rows, np.float32)
    size = min(n, max(PALETTE_MIN, n // PALETTE_SHARE), PALETTE_MAX)
    shared = shared_rows(rows, size)
    if shared is not None:
        return shared[0], shared[1].astype(np.uint16)
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
    """Compute centres (at most count, D) of clusters by Lloyd's algorithm, from rows evenly spaced by weight."""
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
        centres[labels[order][firsts]] = sums / mass  # centres without a row stay
    return centres


def _closest(rows: Array, centres: Array) -> Array:
    """Find the index of the nearest centre of each row, (N,)."""
    from scipy.cluster.vq import vq

    return vq(rows, centres, check_finite=False)[0]
