"""Twin of the stage removal: without a splat, everything behind it is brighter by the factor 1/(1 - alpha)."""

from typing import Any

import numpy as np

from clsplat.constants import ALPHA_MAX, TRANSMITTANCE_MIN
from clsplat.reference.composite import hits
from clsplat.stages import AnySplats, Bins, Removal

# Transmittance at which compositing stops here. Without one splat of the largest alpha it would be TRANSMITTANCE_MIN.
STOP = TRANSMITTANCE_MIN * (1 - ALPHA_MAX)


def removal(splats: AnySplats, bins: Bins, background: Any, residuals: Any = None, mask: Any = None) -> Removal:
    """Change of the squared error. Arguments and result as for `clsplat.ops.removal`."""
    n, channels = splats.colors.shape
    transmittance = np.empty((bins.height, bins.width))
    counts = np.ones(transmittance.shape) if mask is None else np.asarray(mask, dtype=np.float64)
    r = np.zeros((*counts.shape, channels)) if residuals is None else residuals * counts[:, :, None]

    behind = np.zeros((*counts.shape, channels))  # the whole image at first
    for hit in hits(splats, bins, transmittance, STOP):
        weight = np.minimum(hit.alpha, ALPHA_MAX) * hit.before
        behind[hit.box] += weight[:, :, None] * splats.colors[hit.splat]
    behind += transmittance[:, :, None] * np.asarray(background, dtype=np.float64)

    errors, differences, weights, squares, shares, pairs = np.zeros((6, n))
    out = Removal(errors, differences, weights, squares, shares, pairs, np.zeros((n, channels)))
    for hit in hits(splats, bins, transmittance, STOP):
        g, alpha = hit.splat, np.minimum(hit.alpha, ALPHA_MAX)
        weight = alpha * hit.before
        part = weight[:, :, None] * splats.colors[g]
        behind[hit.box] -= part
        less = part - (alpha / (1 - alpha))[:, :, None] * behind[hit.box]
        difference = (counts[hit.box][:, :, None] * less**2).sum()
        out.errors[g] += difference - 2 * (r[hit.box] * less).sum()
        out.differences[g] += difference
        out.weights[g] += (weight * counts[hit.box]).sum()
        out.squares[g] += (weight**2 * counts[hit.box]).sum()
        out.shares[g] += (weight[:, :, None] * r[hit.box] ** 2).sum()
        out.pairs[g] += ((weight > 0) * counts[hit.box]).sum()
        out.pulls[g] += np.einsum("hw,hwc->c", weight, r[hit.box])
    return out


def removal_sums(splats: AnySplats, bins: Bins, background: Any, residuals: Any = None, mask: Any = None) -> Any:
    """The same as columns. Arguments and result as for `clsplat.ops.removal_sums`."""
    return np.column_stack(removal(splats, bins, background, residuals, mask))


def removal_residuals(image: Any, photo: Any, *, clamped: bool = False) -> Any:
    """Residuals. Arguments and result as for `clsplat.ops.removal_residuals`."""
    return (np.clip(image, 0, 1) if clamped else image) - photo / 255
