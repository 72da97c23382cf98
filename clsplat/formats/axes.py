"""Whole scenes in another place: the axes of a format in place of those of a PLY, and poses that a file declares.

The axes of a PLY from photogrammetry are right, down, forward.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians
from clsplat.reference.sh import BASIS, sh_basis

Array = NDArray[Any]

RIGHT_UP_BACK = (1.0, -1.0, -1.0)
"""Signs by which the coordinates change from right, down, forward to right, up, back (OpenGL, .spz): half a turn
about x."""

LEFT_UP_FORWARD = (-1.0, -1.0, 1.0)
"""Signs by which the coordinates change to left, up, forward (glTF): half a turn about z."""

DIRECTIONS = 64
"""Number of directions from which the rotation of the spherical harmonics is computed: more than the 16 coefficients,
so that the system is well conditioned."""

FAR = 1000.0
"""Distance of a scene from the origin, over its size, from which on it is kept in the offset: single precision
resolves 6e-5 of the size there."""


def turned(gaussians: Gaussians, signs: tuple[float, float, float]) -> Gaussians:
    """Turn a scene by half a turn about one axis, whose sign in `signs` is positive; twice is the identity, exactly.

    A basis function of the spherical harmonics changes its sign as the first of its monomials does: all have the same
    parity in each coordinate.
    """
    parities = np.array([terms[0][1] for terms in BASIS])
    sh_signs = np.prod(np.where(parities % 2, signs, 1.0), axis=1).astype(np.float32)
    axes = np.array(signs, np.float32)
    return Gaussians(
        gaussians.means * axes,
        gaussians.log_scales,
        gaussians.quats * np.append(np.float32(1), axes),
        gaussians.logit_opacities,
        gaussians.sh * sh_signs[: gaussians.sh.shape[1], None],
    )


def rotated(gaussians: Gaussians, rotation: Array) -> Gaussians:
    """The Gaussians in a world turned by `rotation` (3, 3), including their view dependence.

    The turned colour is c'(d) = c(R^T d) for every direction d. A least-squares fit over directions finds the new
    coefficients. The fit is exact, because the basis of each degree is closed under rotations.
    """
    from scipy.spatial.transform import Rotation

    if np.array_equal(rotation, np.eye(3)):
        return gaussians
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    degree, dtype = gaussians.sh_degree, gaussians.means.dtype
    new, old = sh_basis(directions, degree), sh_basis(directions @ rotation, degree)
    matrix = np.linalg.lstsq(new, old, rcond=None)[0]
    quats = gaussians.quats.copy()
    oriented = np.flatnonzero(quats.any(axis=1))  # others are not drawn
    turn = Rotation.from_matrix(rotation) * Rotation.from_quat(np.roll(quats[oriented], -1, axis=1))
    quats[oriented] = np.roll(turn.as_quat(), 1, axis=1)
    return replace(
        gaussians,
        means=(gaussians.means @ rotation.T).astype(dtype),
        quats=quats,
        sh=np.einsum("kl,nlc->nkc", matrix, gaussians.sh).astype(dtype),
    )


def placed(
    gaussians: Gaussians, offset: Array, scale: float, rotation: Array, translation: Array
) -> tuple[Gaussians, Array]:
    """Place a scene elsewhere: x -> scale R x + t for the world coordinates x, which are the means plus the offset.

    Parameters
    ----------
    gaussians : Gaussians
    offset, translation : (3,) float64
    scale : float
    rotation : (3, 3) float64

    Returns
    -------
    gaussians : Gaussians
    offset : (3,) float64
        With the translation, if there was an offset, or if single precision would blur the scene there.
    """
    result, dtype, offset = rotated(gaussians, rotation), gaussians.means.dtype, scale * rotation @ offset
    means = scale * result.means.astype(np.float64)
    if offset.any() or np.linalg.norm(translation) > FAR * np.abs(means - means.mean(axis=0)).max():
        offset = offset + translation
    else:
        means = means + translation
    log_scales = (result.log_scales + np.log(scale)).astype(dtype)
    return replace(result, means=means.astype(dtype), log_scales=log_scales), offset
