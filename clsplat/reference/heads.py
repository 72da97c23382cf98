"""Twin of the stage heads."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import DENSITY_SHIFT, EXPONENT_MAX
from clsplat.reference.sh import sh_basis

Array = NDArray[Any]


def heads_join(features: Array, directions: Array, rays_of: Array) -> Array:
    """Join directions with features. Arguments and result as for `clsplat.ops.heads_join`."""
    return np.concatenate([sh_basis(directions, 3)[rays_of], features], axis=1)


def heads_fwd(features: Array, outputs: Array) -> tuple[Array, Array]:
    """Densities and colours. Arguments and results as for `clsplat.ops.heads_fwd`."""
    sigmas = np.exp(np.clip(features[:, 0], -EXPONENT_MAX, EXPONENT_MAX))
    return sigmas, 1 / (1 + np.exp(-outputs[:, :3]))


def heads_bwd(colors: Array, v_colors: Array) -> Array:
    """Gradient of the colours. Arguments and result as for `clsplat.ops.heads_bwd`."""
    v_outputs = np.zeros((len(colors), 16))
    v_outputs[:, :3] = v_colors * colors * (1 - colors)
    return v_outputs


def heads_join_bwd(v_inputs: Array, features: Array, sigmas: Array, v_sigmas: Array) -> Array:
    """Gradient of the features. Arguments and result as for `clsplat.ops.heads_join_bwd`."""
    v_features = v_inputs[:, 16:].copy()
    v_features[:, 0] += np.where(np.abs(features[:, 0]) < EXPONENT_MAX, v_sigmas * sigmas, 0)
    return v_features


def _sh_colors(features: Array, directions: Array, rays_of: Array) -> tuple[Array, Array]:
    """Basis (S, 9) or (S, 1), and colours (S, 3) before the limit at 0."""
    basis = sh_basis(directions, 2 if features.shape[1] == 28 else 0)[rays_of]
    return basis, 0.5 + np.einsum("sb,skb->sk", basis, features[:, 1:].reshape(len(features), 3, -1))


def heads_sh_fwd(features: Array, directions: Array, rays_of: Array, density_scale: float) -> tuple[Array, Array]:
    """Densities and colours of Plenoxels. Arguments and results as for `clsplat.ops.heads_sh_fwd`."""
    colors = _sh_colors(features, directions, rays_of)[1]
    return density_scale * np.maximum(features[:, 0], 0), np.maximum(colors, 0)


def heads_sh_bwd(
    features: Array,
    directions: Array,
    rays_of: Array,
    density_scale: float,
    v_sigmas: Array,
    v_colors: Array,
) -> Array:
    """Gradient of `heads_sh_fwd`. Arguments and result as for `clsplat.ops.heads_sh_bwd`."""
    basis, colors = _sh_colors(features, directions, rays_of)
    v_density = np.where(features[:, 0] > 0, density_scale * v_sigmas, 0)
    v_harmonics = np.where(colors > 0, v_colors, 0)[:, :, None] * basis[:, None]
    return np.concatenate([v_density[:, None], v_harmonics.reshape(len(features), -1)], axis=1)


def heads_soft_fwd(features: Array, outputs: Array, density_scale: float) -> tuple[Array, Array]:
    """Densities by softplus, and colours. Arguments and results as for `clsplat.ops.heads_soft_fwd`."""
    sigmas = density_scale * np.logaddexp(features[:, 0] - DENSITY_SHIFT, 0)
    return sigmas, 1 / (1 + np.exp(-outputs[:, :3]))


def heads_soft_bwd(features: Array, density_scale: float, v_sigmas: Array, v_features: Array) -> None:
    """Add the gradient of the densities. Arguments as for `clsplat.ops.heads_soft_bwd`."""
    v_features[:, 0] += v_sigmas * density_scale / (1 + np.exp(DENSITY_SHIFT - features[:, 0]))
