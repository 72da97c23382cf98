"""Merging: two neighbouring Gaussians become one with the same moments.

The mass of a Gaussian is its optical depth -ln(1 - opacity) times the mean area of its projections. The merged
Gaussian has the sum of both masses, and the mean, covariance and colour of the two as a mixture weighted by mass.
Opacities that follow from optical depths stay below 1, and Gaussians at the same place merge into what both show
together.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import ALPHA_MAX, BLUR
from clsplat.gaussians import Gaussians, logit
from clsplat.pruning.prices import Prices
from clsplat.reference.project import rotations
from clsplat.reference.sh import sh_basis

Array = NDArray[Any]

NEIGHBOURS = 4
"""Number of nearest Gaussians with which each one may be merged."""

GRID = 9
"""Number of points per axis at which a merged Gaussian is compared with the two it replaces."""

REACH = 3.0
"""Largest coordinate of these points, standard deviations of the merged Gaussian; beyond it lies 1 % of its mass."""

CHUNK = 1 << 13
"""Number of pairs that are compared at a time, which bounds the memory."""

VISIBLE_MIN = 1e-3
"""Smallest visible fraction that counts, so that hidden Gaussians still have a mass."""

AREA_POWER = 1.6075
"""Exponent of Thomsen's formula for the surface of an ellipsoid, which is right to 1.1 %
(https://mathworld.wolfram.com/Ellipsoid.html)."""


def covariances(gaussians: Gaussians) -> Array:
    """Covariances in world units, (N, 3, 3) float64; without an orientation, those of unturned Gaussians."""
    quats = gaussians.quats.astype(np.float64)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    axes = rotations(np.divide(quats, lengths, out=np.tile([1.0, 0, 0, 0], (len(quats), 1)), where=lengths > 0))
    axes = axes * np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]
    return np.asarray(axes @ axes.transpose(0, 2, 1))


def neighbours(gaussians: Gaussians) -> NDArray[np.intp]:
    """Pairs (P, 2) of Gaussians, one of which is among the `NEIGHBOURS` nearest of the other, in ascending order; the
    smaller index is first."""
    from scipy.spatial import cKDTree

    n = len(gaussians)
    near = cKDTree(gaussians.means).query(gaussians.means, min(NEIGHBOURS + 1, n))[1]
    first = np.repeat(np.arange(n), near.shape[1])
    second = near.ravel()
    # A pair as one number, and no np.unique: each takes several times as long on its way.
    keys = np.sort((np.minimum(first, second) * n + np.maximum(first, second))[first != second])
    return np.stack(np.divmod(keys[np.diff(keys, prepend=-1) > 0], n), axis=1)


def masses(gaussians: Gaussians) -> Array:
    """Masses, (N,) float64: optical depth times the mean area of the projections, up to a constant factor."""
    return _depths(gaussians.opacities) * _areas(np.exp(gaussians.log_scales.astype(np.float64)))


def merged(gaussians: Gaussians, pairs: Array, visible: Array | None = None) -> Gaussians:
    """Merge pairs of Gaussians by matched moments.

    Parameters
    ----------
    gaussians : Gaussians
    pairs : (P, 2) int
        Rows of the two Gaussians of each pair.
    visible : (P, 2), optional
        Factors of their masses, so that what is hidden counts less; default: 1.

    Returns
    -------
    Gaussians
        P rows of the same type.
    """
    means = gaussians.means[pairs].astype(np.float64)
    scales = np.exp(gaussians.log_scales[pairs].astype(np.float64))
    mass = _depths(gaussians.opacities[pairs]) * _areas(scales)
    if visible is not None:
        mass = mass * visible
    total = mass.sum(axis=1)
    share = np.divide(mass, total[:, None], out=np.full_like(mass, 0.5), where=total[:, None] > 0)
    spread = means[:, 1] - means[:, 0]
    each = covariances(gaussians.take(pairs.ravel())).reshape(-1, 2, 3, 3)
    covariance = np.einsum("pk,pkij->pij", share, each)
    covariance += (share[:, 0] * share[:, 1])[:, None, None] * spread[:, :, None] * spread[:, None, :]
    log_scales, quats = _decomposed(covariance)
    opacities = -np.expm1(-total / _areas(np.exp(log_scales)))
    return Gaussians(
        np.einsum("pk,pki->pi", share, means),
        log_scales,
        quats,
        logit(np.clip(opacities, np.finfo(np.float32).tiny, 1 - 1e-7)),
        np.einsum("pk,pkac->pac", share, gaussians.sh[pairs].astype(np.float64)),
    ).astype(gaussians.means.dtype)


def merged_as_seen(gaussians: Gaussians, pairs: Array, prices: Prices) -> Gaussians:
    """Merge pairs of Gaussians whose masses count as far as the views that priced them show them."""
    grains = prices.grains / np.maximum(prices.squares, np.finfo(np.float64).tiny)
    scales = np.sqrt(np.exp(2 * gaussians.log_scales.astype(np.float64)) + BLUR * grains[:, None])
    visible = (prices.weights / np.maximum(gaussians.opacities * _areas(scales), np.finfo(np.float64).tiny))[pairs]
    most = visible.max(axis=1, keepdims=True)
    relative = np.where(most > 0, visible / np.where(most > 0, most, 1), 1)
    return merged(gaussians, pairs, np.maximum(relative, VISIBLE_MIN))


def least_costs(gaussians: Gaussians, pairs: Array, prices: Prices) -> Array:
    """Changes that merging makes to the views if the two Gaussians differ in colour alone, (P,): a quick estimate,
    which `merge_costs` seldom undercuts."""
    length = np.linalg.norm(prices.sights, axis=1, keepdims=True)
    basis = sh_basis(prices.sights / np.maximum(length, np.finfo(np.float64).tiny), gaussians.sh_degree)
    colors = np.einsum("na,nac->nc", basis, gaussians.sh)
    gaps = ((colors[pairs[:, 0]] - colors[pairs[:, 1]]) ** 2).sum(axis=1)
    squares = np.maximum(prices.squares[pairs], np.finfo(np.float64).tiny)
    return np.asarray(gaps * squares[:, 0] * squares[:, 1] / squares.sum(axis=1))


def merge_costs(gaussians: Gaussians, pairs: Array, prices: Prices) -> Array:
    """Estimate the changes that merging makes to the views, (P,), in the unit of `Prices.differences`.

    The two Gaussians and the merged one are compared on a grid of points in the plane perpendicular to the mean
    direction of the views, with the blur of a mean pixel. What lies in front of them and behind is known from the
    prices: the sum of the squared weights tells how much of them is visible, and the price of removal how much they
    differ from what they hide.

    Parameters
    ----------
    gaussians : Gaussians
    pairs : (P, 2) int
    prices : Prices
        Of the same Gaussians.
    """
    parts = [pairs[i : i + CHUNK] for i in range(0, len(pairs), CHUNK)]
    return np.concatenate([np.zeros(0), *(_chunk_costs(gaussians, part, prices) for part in parts)])


def _chunk_costs(gaussians: Gaussians, pairs: Array, prices: Prices) -> Array:
    both = merged_as_seen(gaussians, pairs, prices)
    squares = prices.squares[pairs].sum(axis=1)
    known = np.maximum(squares, np.finfo(np.float64).tiny)
    plane, direction = _planes(prices.sights[pairs].sum(axis=1))
    blur = BLUR * prices.grains[pairs].sum(axis=1) / known

    def flat(covariance: Array) -> Array:
        projected = plane.transpose(0, 2, 1) @ covariance @ plane
        return np.asarray(projected + blur[:, None, None] * np.eye(2))

    spread = flat(covariances(both))
    factor = np.linalg.cholesky(spread)
    axis = np.linspace(-REACH, REACH, GRID)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    places = np.einsum("pij,gj->pgi", factor, points)
    element = np.linalg.det(factor) * (axis[1] - axis[0]) ** 2  # area that a point stands for

    def alphas(opacity: Array, offset: Array, covariance: Array) -> Array:
        d = places - np.einsum("pij,pi->pj", plane, offset)[:, None]
        (a, b), (_, c) = np.moveaxis(np.linalg.inv(covariance), 0, 2)[..., None]
        x, y = d[:, :, 0], d[:, :, 1]
        exponent = a * x * x + 2 * b * x * y + c * y * y
        return np.asarray(np.minimum(opacity, ALPHA_MAX)[:, None] * np.exp(-exponent / 2))

    opacities, basis = gaussians.opacities, sh_basis(direction, gaussians.sh_degree)
    shown = alphas(both.opacities, np.zeros((len(pairs), 3)), spread)
    color = np.einsum("pa,pac->pc", basis, both.sh)
    clear, off, energy = np.ones_like(shown), np.zeros((*shown.shape, 3)), np.zeros(len(pairs))
    for k in range(2):
        i = pairs[:, k]
        covariance = flat(covariances(gaussians.take(i)))
        alpha = alphas(opacities[i], gaussians.means[i] - both.means, covariance)
        off += alpha[:, :, None] * (np.einsum("pa,pac->pc", basis, gaussians.sh[i]) - color)[:, None]
        clear *= 1 - alpha
        energy += np.minimum(opacities[i], ALPHA_MAX) ** 2 * np.pi * np.sqrt(np.linalg.det(covariance))
    contrast = prices.differences[pairs].sum(axis=1) / known
    change = contrast * ((1 - clear - shown) ** 2).sum(axis=1) + (off**2).sum(axis=(1, 2))
    return np.asarray(squares / energy * element * change)


def _depths(opacities: Array) -> Array:
    """Optical depths."""
    return -np.log1p(-np.minimum(opacities.astype(np.float64), 1 - 1e-7))


def _areas(scales: Array) -> Array:
    """Areas of ellipsoids' projections, mean over directions, less a constant factor; Cauchy: a quarter of the
    surface."""
    powers = scales**AREA_POWER
    a, b, c = np.moveaxis(powers, -1, 0)
    return np.asarray(((a * b + a * c + b * c) / 3) ** (1 / AREA_POWER))


def _decomposed(covariance: Array) -> tuple[Array, Array]:
    """Log scales and quaternions wxyz of covariances (P, 3, 3)."""
    from scipy.spatial.transform import Rotation

    variances, axes = np.linalg.eigh(covariance)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    smallest = np.finfo(np.float64).tiny
    quats = Rotation.from_matrix(axes).as_quat() if len(axes) else np.zeros((0, 4))
    return np.log(np.maximum(variances, smallest)) / 2, np.roll(quats, 1, axis=1)


def _planes(sights: Array) -> tuple[Array, Array]:
    """Two unit vectors perpendicular to each vector (P, 3, 2), and its direction (P, 3); z for zero vectors."""
    length = np.linalg.norm(sights, axis=1, keepdims=True)
    direction = np.where(length > 0, sights / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))
    helper = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(direction, first)], axis=2), direction
