"""Twin of the stage adam, in the dtype of its arrays. It is also the optimiser of ``--optimizer numpy``."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import SHAPES, Gaussians, sigmoid
from clsplat.stages import ERANK_SLACK, AdamStep

Array = NDArray[Any]

# Number of values updated at once. Their five arrays fit into a core's L2 cache.
BLOCK = 32768


def adam_step(
    gaussians: Gaussians,
    gradients: Gaussians,
    first: Gaussians,
    second: Gaussians,
    step: AdamStep,
    extents: Array | None = None,
) -> None:
    """Take one step of Adam (Kingma and Ba 2015, algorithm 1), in place. Arguments as for `clsplat.ops.adam_step`."""
    correction1, correction2 = 1 - step.beta1**step.iteration, 1 - step.beta2**step.iteration
    n = len(gaussians)
    shown = np.ones((n, 1), bool) if extents is None else extents[:, :1] > 0
    for name in SHAPES:
        width = 3 * (step.sh_degree + 1) ** 2 if name == "sh" else max(1, gaussians.arrays()[name][:1].size)
        rate: Any
        if name == "sh":
            rate = np.full(width, step.rates["sh_rest"], gaussians.sh.dtype)
            rate[:3] = step.rates["sh0"]
        else:
            rate = step.rates[name]
        p, g, m, v = (getattr(c, name).reshape(n, -1)[:, :width] for c in (gaussians, gradients, first, second))
        g = np.where(shown, _penalised(name, p, g, step), g)
        rows = max(1, BLOCK // width)
        for begin in range(0, n, rows):
            block = slice(begin, begin + rows)
            _update(p[block], g[block], m[block], v[block], rate / correction1, correction2, step)


def adam_array(
    parameters: Array,
    gradients: Array,
    first: Array,
    second: Array,
    rate: float,
    step: AdamStep,
    *,
    sparse: bool = False,
) -> None:
    """Take one step of Adam on an array, in place. Arguments as for `clsplat.ops.adam_array`."""
    correction1, correction2 = 1 - step.beta1**step.iteration, 1 - step.beta2**step.iteration
    kept = gradients != 0 if sparse else np.ones(gradients.shape, bool)
    p, m, v = (array[kept] for array in (parameters, first, second))
    _update(p, gradients[kept], m, v, rate / correction1, correction2, step)
    parameters[kept], first[kept], second[kept] = p, m, v


def _penalised(name: str, p: Array, g: Array, step: AdamStep) -> Array:
    """Add the gradients of the penalties: d exp(p)/dp = exp(p), and o (1 - o) for o = sigmoid(p)."""
    opacity, scale, erank = step.penalties
    if name == "log_scales" and scale:
        g = g + scale * np.exp(p)
    if name == "log_scales" and erank:
        g = g + erank * erank_gradient(p)
    if name == "logit_opacities" and opacity:
        return g + opacity * sigmoid(p) * sigmoid(-p)
    return g


def erank_gradient(log_scales: Array) -> Array:
    """Gradient (N, 3) of max(-ln(erank - 1 + ERANK_SLACK), 0) by ln(scales) (N, 3).

    The effective rank erank is exp(entropy of s^2 / sum of s^2) (Hyung et al. 2024, equations 5 and 8).
    """
    log_q = 2 * (log_scales - log_scales.max(axis=1, keepdims=True))
    log_q = log_q - np.log(np.exp(log_q).sum(axis=1, keepdims=True))
    q = np.exp(log_q)
    entropy = -(q * log_q).sum(axis=1, keepdims=True)
    excess = np.expm1(entropy) + ERANK_SLACK
    return np.where(excess < 1, 2 * np.exp(entropy) / excess * q * (log_q + entropy), 0)


def _update(p: Array, g: Array, m: Array, v: Array, rate: Any, correction2: float, step: AdamStep) -> None:
    m *= step.beta1
    m += (1 - step.beta1) * g
    v *= step.beta2
    v += (1 - step.beta2) * (g * g)
    denominator = np.sqrt(v * (1 / correction2))
    denominator += step.eps
    p -= rate * (m / denominator)
