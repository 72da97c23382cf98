"""Twin of the stage frustums."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import FRUSTUM_AXES, Span, frustum_width
from clsplat.reference.intervals import distances
from clsplat.reference.march import contract

Array = NDArray[Any]


def gaussians_of(origins: Array, directions: Array, radii: Array, t: Array) -> tuple[Array, Array]:
    """Means (R, N, 3) and covariances (R, N, 3, 3) of the frustums between distances t (R, N + 1)."""
    middle, half = (t[:, 1:] + t[:, :-1]) / 2, np.diff(t, axis=1) / 2
    q = np.maximum(3 * middle**2 + half**2, 1e-30)
    mean = middle + 2 * middle * half**2 / q
    along = half**2 / 3 - 4 / 15 * half**4 * (12 * middle**2 - half**2) / q**2
    across = radii[:, None] ** 2 * (middle**2 / 4 + 5 / 12 * half**2 - 4 / 15 * half**4 / q)
    outer = (directions[:, :, None] * directions[:, None])[:, None]
    covariances = along[:, :, None, None] * outer + across[:, :, None, None] * (np.eye(3) - outer)
    return origins[:, None] + mean[:, :, None] * directions[:, None], covariances


def contraction_jacobians(x: Array) -> Array:
    """Derivatives (..., 3, 3) of the contraction at points (..., 3)."""
    n = np.maximum(np.linalg.norm(x, axis=-1), 1)[..., None, None]
    g = 2 / n - 1 / n**2
    jacobians = g * np.eye(3) + (1 / n**2 - g) / n**2 * x[..., :, None] * x[..., None, :]
    return np.where(n > 1, jacobians, np.eye(3))


def frustums_encode(
    origins: Array, directions: Array, radii: Array, edges: Array, span: Span, levels: int
) -> tuple[Array, Array]:
    """Integrated encodings. Arguments and results as for `clsplat.ops.frustums_encode`."""
    t = distances(origins, directions, edges, span)
    x, covariances = gaussians_of(origins, directions, radii, t)
    jacobians = contraction_jacobians(x) if span.contracted else np.broadcast_to(2 * np.eye(3), covariances.shape)
    y = contract(x) if span.contracted else 2 * x - 1
    axes = np.array(FRUSTUM_AXES)
    turned = np.einsum("...ij,aj->...ai", jacobians, axes)  # J is symmetric
    variances = np.einsum("...ai,...ij,...aj->...a", turned, covariances, turned).reshape(-1, 1, len(axes))
    means = (y @ axes.T).reshape(-1, 1, len(axes))
    k = np.arange(levels)[:, None]
    kept = np.exp(-(4.0**k) * variances / 2)
    waves = np.stack([kept * np.sin(2.0**k * means), kept * np.cos(2.0**k * means)], axis=-1)
    encoded = np.zeros((len(means), frustum_width(levels)))
    used = 2 * levels * len(axes)
    encoded[:, :used], encoded[:, used] = waves.reshape(len(means), -1), 1
    return encoded, np.diff(t, axis=1).ravel()
