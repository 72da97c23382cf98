"""Twin of the stage absgrad: absolute values of what the twin of composite adds up per pixel."""

import numpy as np
from numpy.typing import NDArray

from clsplat.reference.composite import gradient_of_sigma, hits
from clsplat.stages import AnySplats, Bins, Image


def absgrad(splats: AnySplats, bins: Bins, image: Image, v_image: Image) -> NDArray[np.float64]:
    """Sums of the absolute gradients by the centres. Arguments and result as for `clsplat.ops.absgrad`."""
    sums = np.zeros(splats.means2d.shape)
    behind = (image.rgb * v_image.rgb).sum(axis=2) - (1 - image.alpha) * v_image.alpha
    for hit in hits(splats, bins, np.empty(image.alpha.shape)):
        u = v_image.rgb[hit.box] @ splats.colors[hit.splat]
        v_sigma, _, behind[hit.box] = gradient_of_sigma(hit.alpha, hit.before, u, behind[hit.box])
        a, b, c = splats.conics[hit.splat]
        slopes = a * hit.dx + b * hit.dy, b * hit.dx + c * hit.dy
        sums[hit.splat] += [np.abs(v_sigma * slope).sum() for slope in slopes]
    sums[~np.isfinite(sums).all(axis=1)] = 0
    return sums
