"""Twin of the stage median: the splat at which a pixel's transmittance falls to 1/2 or below."""

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import ALPHA_MAX
from clsplat.reference.composite import hits
from clsplat.stages import AnySplats, Bins


def median_splats(splats: AnySplats, bins: Bins) -> NDArray[np.int32]:
    """The splat that is the surface in each pixel. Arguments and result as for `clsplat.ops.median_splats`."""
    ids = np.full((bins.height, bins.width), -1, np.int32)
    for hit in hits(splats, bins, np.empty(ids.shape), transmittance_min=-1.0):  # a pixel need not stop
        behind = hit.before * (1 - np.minimum(hit.alpha, ALPHA_MAX))
        ids[hit.box][(hit.alpha > 0) & (behind <= 0.5) & (ids[hit.box] < 0)] = hit.splat
    return ids
