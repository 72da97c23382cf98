"""Twin of the stage dropout."""

import numpy as np

from clsplat.constants import ALPHA_MIN, EXTENT_SLACK
from clsplat.reference.noise import philox
from clsplat.stages import AnyGrads, AnySplats, Dropout, RaySplats


def dropout_fwd(splats: AnySplats, dropout: Dropout) -> None:
    """Drop random splats, in place. Arguments as for `clsplat.ops.dropout_fwd`."""
    n = len(splats.opacities)
    counters = np.zeros((n, 4), np.uint32)
    counters[:, 0], counters[:, 1], counters[:, 2] = np.arange(n), dropout.iteration, 1
    kept = philox(counters, (dropout.seed & 0xFFFFFFFF, dropout.seed >> 32))[:, 0] >= dropout.threshold
    shown = (splats.extents[:, 0] > 0) & (splats.depths <= dropout.far)
    before = splats.opacities[shown]
    after = np.where(kept[shown], dropout.gain * before, 0)
    splats.opacities[shown] = after
    if isinstance(splats, RaySplats):  # its outline is that of the new opacity
        splats.extents[shown] *= (after > 0)[:, None]
        return
    with np.errstate(divide="ignore"):
        squares = (np.log(after / ALPHA_MIN) + EXTENT_SLACK) / (np.log(before / ALPHA_MIN) + EXTENT_SLACK)
    splats.extents[shown] *= np.sqrt(np.maximum(squares, 0))[:, None]


def dropout_bwd(splats: AnySplats, v_splats: AnyGrads, dropout: Dropout) -> None:
    """Gradients of `dropout_fwd`, in place. Arguments as for `clsplat.ops.dropout_bwd`."""
    v_splats.opacities[splats.depths <= dropout.far] *= dropout.gain
