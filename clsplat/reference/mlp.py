"""Twin of the stage mlp."""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def _matrices(weights: Array, widths: tuple[int, ...]) -> list[Array]:
    """The matrix of each layer, as a view."""
    sizes = [a * b for a, b in pairwise(widths)]
    parts = np.split(weights, np.cumsum(sizes)[:-1])
    return [part.reshape(a, b) for part, (a, b) in zip(parts, pairwise(widths), strict=True)]


def mlp_fwd(inputs: Array, weights: Array, widths: tuple[int, ...]) -> tuple[Array, Array]:
    """Apply a network. Arguments and results as for `clsplat.ops.mlp_fwd`."""
    *matrices, last = _matrices(weights, widths)
    x, hidden = inputs, [np.zeros(0)]
    for matrix in matrices:
        x = np.maximum(x @ matrix, 0)
        hidden.append(x.ravel())
    return x @ last, np.concatenate(hidden)


def mlp_bwd(
    inputs: Array,
    weights: Array,
    widths: tuple[int, ...],
    hidden: Array,
    v_outputs: Array,
    columns: int,
    v_weights: Array | None = None,
) -> tuple[Array, Array]:
    """Gradients of `mlp_fwd`. Arguments and results as for `clsplat.ops.mlp_bwd`."""
    rows, v, found = len(inputs), v_outputs, []
    layers = [part.reshape(rows, -1) for part in np.split(hidden, rows * np.cumsum(widths[1:-1], dtype=int)[:-1])]
    before = [inputs, *(layers if len(widths) > 2 else [])]
    for index, matrix in reversed(list(enumerate(_matrices(weights, widths)))):
        found.append((before[index].T @ v).ravel())
        v = v @ matrix.T
        if index:
            v = np.where(before[index] > 0, v, 0)
    v_weights = np.zeros(len(weights)) if v_weights is None else v_weights
    v_weights += np.concatenate(found[::-1])
    return v[:, :columns], v_weights
