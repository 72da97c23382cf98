"""Twin of the stage histograms."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import INTERLEVEL_EPS

Array = NDArray[Any]


def histograms_interlevel(
    edges: Array, weights: Array, outer_edges: Array, outer_weights: Array, scale: float
) -> tuple[Array, Array]:
    """Loss between levels. Arguments and results as for `clsplat.ops.histograms_interlevel`."""
    inner, outer = weights.reshape(len(edges), -1), outer_weights.reshape(len(edges), -1)
    overlaps = (outer_edges[:, None, :-1] < edges[:, 1:, None]) & (outer_edges[:, None, 1:] > edges[:, :-1, None])
    excess = np.maximum(inner - np.einsum("rij,rj->ri", overlaps, outer), 0)
    ratios = excess / (inner + INTERLEVEL_EPS)
    return (excess * ratios).sum(axis=1), -2 * scale * np.einsum("rij,ri->rj", overlaps, ratios).ravel()


def histograms_distortion(edges: Array, weights: Array, scale: float) -> tuple[Array, Array]:
    """Loss of the spread. Arguments and results as for `clsplat.ops.histograms_distortion`."""
    w, middles, lengths = weights.reshape(len(edges), -1), (edges[:, 1:] + edges[:, :-1]) / 2, np.diff(edges, axis=1)
    apart = np.einsum("rij,rj->ri", np.abs(middles[:, :, None] - middles[:, None]), w)
    losses = (w * apart).sum(axis=1) + (w**2 * lengths).sum(axis=1) / 3
    return losses, 2 * scale * (apart + w * lengths / 3).ravel()
