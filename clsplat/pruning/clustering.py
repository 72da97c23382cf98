"""K-means in which each row has its own metric.

The cost of an entry c for a row x is (x - c)^T M (x - c), summed over the columns of x, with the row's matrix M. But
for a constant this is an inner product of a vector that depends on the row and one that depends on the entry. A table
of costs is therefore a product of two matrices, and the sums of the rows' vectors determine the best entries.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

ITERATIONS = 4
"""Number of iterations of Lloyd's algorithm, as in `clsplat.formats.codebook`."""

TRAINING = 32
"""Mean number of rows per entry from which the entries are computed; all rows are assigned in the end."""

LEAF = 512
"""Mean number of entries with which each row is compared. A larger palette is divided into cells of rows first."""

CHUNK = 1 << 25
"""Number of costs in memory at a time."""

RIDGE = 1e-4
"""Fraction of the mean eigenvalue of an entry's summed metrics that pulls it to its previous place, which determines
what no row does."""


def features(rows: Array, metrics: Array) -> Array:
    """Vectors (N, K C + K (K + 1)/2) whose inner product with those of `_entry_features` is the cost less x^T M x.

    Parameters
    ----------
    rows : (N, K, C)
    metrics : (N, K, K)
        Symmetric, positive semidefinite.
    """
    a, b = np.triu_indices(rows.shape[1])
    linear = -2 * metrics @ rows
    return np.concatenate([linear.reshape(len(rows), -1), metrics[:, a, b] * np.where(a == b, 1, 2)], axis=1).astype(
        np.float32
    )


def palette_by_metric(rows: Array, vectors: Array, size: int) -> tuple[Array, Array]:
    """Compute entries that approximate rows, each under its own metric.

    Parameters
    ----------
    rows : (N, K, C)
    vectors : (N, K C + K (K + 1)/2)
        Their `features`.
    size : int
        Largest number of entries.

    Returns
    -------
    entries : (P, K, C) float32
        Entries without a row are left out.
    labels : (N,) int
        Index of the entry of each row.
    """
    if size <= 2 * LEAF:
        return _lloyd(rows, vectors, size)
    centres, cells = _lloyd(rows, vectors, -(-size // LEAF))
    count = len(centres)
    costs = np.maximum(_costs(rows, vectors, centres, cells), 0)
    # Entries in proportion to the root of cost times number, between equal errors and equal numbers.
    shares = np.sqrt(np.bincount(cells, costs, count) * np.bincount(cells, minlength=count))
    shares /= max(shares.sum(), np.finfo(np.float64).tiny)
    entries: list[Array] = []
    labels, begin = np.empty(len(rows), np.intp), 0
    for cell in range(count):
        members = np.flatnonzero(cells == cell)
        found, mine = _lloyd(rows[members], vectors[members], max(1, int((size - count) * shares[cell])))
        labels[members] = begin + mine
        entries.append(found)
        begin += len(found)
    return np.concatenate(entries), labels


def _lloyd(rows: Array, vectors: Array, size: int) -> tuple[Array, Array]:
    step = max(1, len(rows) // (TRAINING * size))
    some, known = rows[::step], vectors[::step]
    # Rows evenly spaced by the root of their weight, as a compromise between what is seen most and the rest.
    squares = known[:, rows.shape[1] * rows.shape[2] :].max(axis=1)
    reached = np.cumsum(np.sqrt(squares), dtype=np.float64)
    start = np.searchsorted(reached, (np.arange(size) + 0.5) / size * reached[-1])
    entries = some[np.unique(np.minimum(start, len(some) - 1))].astype(np.float32)
    for _ in range(ITERATIONS):
        labels = _closest(known, entries)
        costs = _costs(some, known, entries, labels)
        entries = _improved(known, labels, entries)
        # An entry without a row moves to a row that costs most.
        free = np.setdiff1d(np.arange(len(entries)), labels)
        entries[free] = some[np.argsort(-costs, kind="stable")[: len(free)]]
    labels = _closest(vectors, entries)
    used, labels = np.unique(labels, return_inverse=True)
    return entries[used], labels


def _entry_features(entries: Array) -> Array:
    a, b = np.triu_indices(entries.shape[1])
    products = np.einsum("pac,pbc->pab", entries, entries)[:, a, b]
    return np.concatenate([entries.reshape(len(entries), -1), products], axis=1).astype(np.float32)


def _closest(vectors: Array, entries: Array) -> Array:
    """Index of the cheapest entry of each row."""
    table = np.ascontiguousarray(_entry_features(entries).T)
    labels = np.empty(len(vectors), np.intp)
    step = max(1, CHUNK // len(entries))
    for i in range(0, len(vectors), step):
        labels[i : i + step] = (vectors[i : i + step] @ table).argmin(axis=1)
    return labels


def _costs(rows: Array, vectors: Array, entries: Array, labels: Array) -> Array:
    flat = rows.reshape(len(rows), -1)
    own = np.einsum("nk,nk->n", flat, vectors[:, : flat.shape[1]]) / 2
    return np.asarray(np.einsum("nk,nk->n", vectors, _entry_features(entries)[labels]) - own)


def _improved(vectors: Array, labels: Array, entries: Array) -> Array:
    """Entries that cost least for the rows that have them."""
    k, width = entries.shape[1], entries.shape[1] * entries.shape[2]
    order = np.argsort(labels, kind="stable")
    firsts = np.flatnonzero(np.diff(labels[order], prepend=-1))
    ids = labels[order][firsts]
    sums = np.add.reduceat(vectors[order].astype(np.float64), firsts, axis=0)
    a, b = np.triu_indices(k)
    matrices = np.empty((len(ids), k, k))
    matrices[:, a, b] = matrices[:, b, a] = sums[:, width:] / np.where(a == b, 1, 2)
    ridge = RIDGE * np.trace(matrices, axis1=1, axis2=2)[:, None, None] / k + np.finfo(np.float32).tiny
    right = -sums[:, :width].reshape(len(ids), k, -1) / 2 + ridge * entries[ids]
    out = entries.copy()
    out[ids] = np.linalg.solve(matrices + ridge * np.eye(k), right)
    return out
