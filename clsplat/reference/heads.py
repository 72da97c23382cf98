"""Twin of the stage heads."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.reference.sh import sh_basis
from clsplat.stages import EXPONENT_MAX

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
