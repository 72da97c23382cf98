"""Twin of the stage count: counts the pairs that compositing evaluates and draws."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.reference.composite import hits
from clsplat.stages import AnySplats, Bins

Array = NDArray[Any]


def count_pairs(splats: AnySplats, bins: Bins) -> tuple[Array, Array]:
    """Count the pairs of a splat and a pixel. Arguments and result as for `clsplat.ops.count_pairs`."""
    evaluated, accepted = np.zeros((2, bins.height, bins.width), np.uint32)
    for hit in hits(splats, bins, np.empty(evaluated.shape)):
        evaluated[hit.box] += hit.live
        accepted[hit.box] += hit.alpha > 0
    return evaluated, accepted
