"""Twin of the stage rays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import TRANSMITTANCE_MIN
from clsplat.field_stages import RayColors

Array = NDArray[Any]


def rays_fwd(sigmas: Array, colors: Array, deltas: Array, first: Array, background: Any) -> RayColors:
    """Composite the samples of rays. Arguments and result as for `clsplat.ops.rays_fwd`."""
    rays = len(first) - 1
    backgrounds = np.broadcast_to(background, (rays, 3))
    rgb, transmittances, behind = np.zeros((rays, 3)), np.zeros(len(sigmas)), np.ones(rays)
    for r in range(rays):
        own = slice(int(first[r]), int(first[r + 1]))
        depths = sigmas[own] * deltas[own]
        reaching = np.exp(-np.concatenate([[0.0], np.cumsum(depths)]))
        drawn = reaching[:-1] > TRANSMITTANCE_MIN
        transmittances[own] = np.where(drawn, reaching[:-1], 0)
        behind[r] = reaching[drawn.sum()]
        weights = transmittances[own] * -np.expm1(-depths)
        rgb[r] = weights @ colors[own] + behind[r] * backgrounds[r]
    return RayColors(rgb, transmittances, behind)


def rays_bwd(
    sigmas: Array,
    colors: Array,
    deltas: Array,
    first: Array,
    background: Any,
    transmittances: Array,
    v_rgb: Array,
) -> tuple[Array, Array]:
    """Gradients of `rays_fwd`. Arguments and results as for `clsplat.ops.rays_bwd`."""
    v_sigmas, v_colors = np.zeros(len(sigmas)), np.zeros((len(sigmas), 3))
    backgrounds = np.broadcast_to(background, (len(first) - 1, 3))
    for r, seen in enumerate(backgrounds):
        for i in reversed(range(int(first[r]), int(first[r + 1]))):
            if transmittances[i] == 0:
                continue
            alpha = -np.expm1(-sigmas[i] * deltas[i])
            v_colors[i] = transmittances[i] * alpha * v_rgb[r]
            v_sigmas[i] = deltas[i] * transmittances[i] * (1 - alpha) * (v_rgb[r] @ (colors[i] - seen))
            seen = alpha * colors[i] + (1 - alpha) * seen
    return v_sigmas, v_colors
