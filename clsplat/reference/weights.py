"""Twin of the stage weights."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def weights_fwd(sigmas: Array, deltas: Array, count: int) -> Array:
    """Weights of samples. Arguments and result as for `clsplat.ops.weights_fwd`."""
    depths = (sigmas * deltas).reshape(-1, count)
    # Not the sum with a sample less the sample: behind an opaque one nothing would be left of what is before it.
    before = np.cumsum(np.pad(depths[:, :-1], ((0, 0), (1, 0))), axis=1)
    return (np.exp(-before) * -np.expm1(-depths)).ravel()


def weights_bwd(sigmas: Array, deltas: Array, count: int, weights: Array, v_weights: Array, v_sigmas: Array) -> None:
    """Add the gradient. Arguments as for `clsplat.ops.weights_bwd`."""
    through = np.exp(-np.cumsum((sigmas * deltas).reshape(-1, count), axis=1))
    v, pulls = v_weights.reshape(-1, count), (weights * v_weights).reshape(-1, count)
    behind = np.cumsum(np.pad(pulls[:, :0:-1], ((0, 0), (1, 0))), axis=1)[:, ::-1]
    v_sigmas += deltas * (through * v - behind).ravel()
