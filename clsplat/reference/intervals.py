"""Twin of the stage intervals."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import Span
from clsplat.reference.march import contract

Array = NDArray[Any]


def distances(origins: Array, directions: Array, edges: Array, span: Span) -> Array:
    """Distances along rays at edges (R, N + 1) in [0, 1]."""
    if span.contracted:
        begin, end = (t if t <= 1 else 2 - 1 / t for t in (span.near, span.far))
        g = begin * (1 - edges) + end * edges
        return np.where(g > 1, 1 / (2 - np.maximum(g, 1)), g)
    near, far = np.full(len(origins), span.near), np.full(len(origins), span.far)
    for o, d in zip(origins.T, directions.T, strict=True):
        moves = d != 0
        step = np.where(moves, d, 1)
        a, b = -o / step, (1 - o) / step
        near = np.where(moves, np.maximum(near, np.minimum(a, b)), near)
        far = np.where(moves, np.minimum(far, np.maximum(a, b)), np.where((o < 0) | (o > 1), near, far))
    far = np.maximum(far, near)
    return near[:, None] * (1 - edges) + far[:, None] * edges


def intervals_along(
    origins: Array, directions: Array, edges: Array, offsets: Array, span: Span
) -> tuple[Array, Array]:
    """Place samples. Arguments and results as for `clsplat.ops.intervals_along`."""
    t = distances(origins, directions, edges, span)
    deltas = np.diff(t, axis=1)
    places = t[:, :-1] + offsets * deltas
    x = origins[:, None] + places[:, :, None] * directions[:, None]
    points = contract(x) / 2 if span.contracted else 2 * x - 1
    return points.reshape(-1, 3), deltas.ravel()


def intervals_resample(edges: Array, weights: Array, draws: Array, padding: float, power: float, keep: bool) -> Array:
    """Draw places. Arguments and result as for `clsplat.ops.intervals_resample`."""
    count = draws.shape[1]
    shares = (weights.reshape(len(edges), -1) + padding) ** power
    sums = np.concatenate([np.zeros((len(edges), 1)), np.cumsum(shares, axis=1)], axis=1)
    wanted = (np.arange(count) + draws) / count * sums[:, -1:]
    drawn = np.array([np.interp(w, s, e) for w, s, e in zip(wanted, sums, edges, strict=True)])
    return np.sort(np.concatenate([edges, drawn], axis=1), axis=1) if keep else drawn
