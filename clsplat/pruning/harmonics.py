"""Spherical harmonics in fewer numbers, chosen by the error of rendered views.

An image is linear in the colours of the Gaussians. If the coefficients of one Gaussian change by d (K, C), the views
change by d^T H d, squared and summed over the channels, with the curvature H = sum over views of w2 Y Y^T: w2 is the
sum of the squared weights over the pixels (stage removal), Y the basis functions in the direction of the view. A
coefficient that few directions tell from another one may change if the other one makes up for it.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians
from clsplat.pruning.clustering import features, palette_by_metric
from clsplat.pruning.prices import measure_removals, sight
from clsplat.reference.sh import sh_basis
from clsplat.renderer import Renderer
from clsplat.scene import View

Array = NDArray[Any]

SPREAD = 0.02
"""Fraction of a view's weight that counts as seen from all directions, since other views will come (measured:
docs/howto/compact.md)."""

CHUNK = 1 << 13
"""Number of Gaussians whose matrices are in memory at a time."""


def curvatures(gaussians: Gaussians, views: list[View], renderer: Renderer) -> Array:
    """Curvature of the error in the harmonics of each Gaussian.

    Parameters
    ----------
    gaussians, views, renderer
        As given to `clsplat.pruning.prices.price`.

    Returns
    -------
    (N, K (K + 1)/2) float32
        Upper triangles of the matrices, row by row; 0 for a Gaussian that no view shows.
    """
    k = gaussians.sh.shape[1]
    a, b = np.triu_indices(k)
    out = np.zeros((len(gaussians), len(a)), np.float32)
    for measured in measure_removals(renderer, gaussians, views):
        view, part = measured.view, measured.removal
        weights = np.maximum(part.squares, 0) / measured.pixels
        seen = np.flatnonzero(weights > 0)
        basis = sh_basis(sight(gaussians, view.camera)[0][seen], gaussians.sh_degree)
        scaled = (basis * np.sqrt(weights[seen, None])).astype(np.float32)
        for i in range(0, len(seen), CHUNK):
            out[seen[i : i + CHUNK]] += scaled[i : i + CHUNK, a] * scaled[i : i + CHUNK, b]
        # The mean of Y Y^T over all directions is the unit matrix divided by the area of the sphere.
        anywhere = SPREAD / (1 - SPREAD) / (4 * np.pi) * weights[seen]
        out[np.ix_(seen, np.flatnonzero(a == b))] += anywhere[:, None].astype(np.float32)
        del measured
    return out


def fitted_degree(gaussians: Gaussians, curvature: Array, degree: int) -> Gaussians:
    """Drop the bands above `degree`; the others change so that the views change least.

    Parameters
    ----------
    gaussians : Gaussians
    curvature : (N, K (K + 1)/2)
        Of the same Gaussians, from `curvatures`.
    degree : int
        From 0 to the degree of the Gaussians.
    """
    k = (degree + 1) ** 2
    kept = gaussians.sh[:, :k].copy()
    for rows, matrices in _matrices(curvature, gaussians.sh.shape[1]):
        kept[rows] += _substitutes(matrices, k) @ gaussians.sh[rows, k:]
    return replace(gaussians, sh=kept)


def with_shared_bands(gaussians: Gaussians, curvature: Array, size: int) -> Gaussians:
    """Let Gaussians share the bands above 0, in at most `size` versions that change the views least.

    Band 0 makes up for the change of the others as far as possible. Formats that compress store shared bands in few
    bytes.

    Parameters
    ----------
    gaussians : Gaussians
        Of degree 1 or more.
    curvature : (N, K (K + 1)/2)
        Of the same Gaussians, from `curvatures`.
    size : int
        At least 1.
    """
    bands = gaussians.sh[:, 1:]
    parts, substitutes = [], []
    for rows, matrices in _matrices(curvature, gaussians.sh.shape[1]):
        substitute = _substitutes(matrices, 1)
        # What is left of the cost where band 0 is the best one for the others.
        parts.append(features(bands[rows], matrices[:, 1:, 1:] - matrices[:, 1:, :1] @ substitute))
        substitutes.append(substitute)
    entries, labels = palette_by_metric(bands, np.concatenate(parts), size)
    shared = entries[labels]
    base = gaussians.sh[:, :1] + np.concatenate(substitutes) @ (bands - shared)
    return replace(gaussians, sh=np.concatenate([base, shared], axis=1).astype(gaussians.sh.dtype))


def _matrices(curvature: Array, k: int) -> Iterator[tuple[slice, Array]]:
    """Yield rows and their full matrices (N, K, K) float64, a chunk at a time."""
    a, b = np.triu_indices(k)
    for i in range(0, len(curvature), CHUNK):
        rows = slice(i, i + CHUNK)
        matrices = np.empty((len(curvature[rows]), k, k))
        matrices[:, a, b] = matrices[:, b, a] = curvature[rows]
        yield rows, matrices


def _substitutes(matrices: Array, k: int) -> Array:
    """Matrices (N, k, K - k) that say which change of the first k coefficients makes up best for the loss of the
    others."""
    own = matrices[:, :k, :k]
    scale = np.trace(own, axis1=1, axis2=2)[:, None, None]
    unseen = np.where(scale > 0, 0, 1)
    return np.linalg.solve(own + unseen * np.eye(k), matrices[:, :k, k:])
