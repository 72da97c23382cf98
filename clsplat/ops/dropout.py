"""Launch of the stage dropout (cl/dropout.cl)."""

import numpy as np

from clsplat.device import Device
from clsplat.stages import AnyGrads, AnySplats, Dropout, RaySplats


def dropout_fwd(device: Device, splats: AnySplats, dropout: Dropout) -> None:
    """Drop random splats and make the others more opaque, in place.

    Parameters
    ----------
    splats : Splats or RaySplats of N >= 1 rows
        Dropped splats become invisible: their extents and opacities are 0. Those along rays are projected with the
        dropout's gain.
    dropout : Dropout
        Splats beyond its depth `far` stay as they are.
    """
    n = len(splats.opacities)
    key = np.array([dropout.seed & 0xFFFFFFFF, dropout.seed >> 32], np.uint32)
    scalars = [n, key, np.uint32(dropout.iteration), np.uint32(dropout.threshold), dropout.gain]
    scalars += [int(isinstance(splats, RaySplats)), float(dropout.far)]
    device.launch("dropout", "dropout_fwd", (n,), [*scalars, splats.depths, splats.extents, splats.opacities])


def dropout_bwd(device: Device, splats: AnySplats, v_splats: AnyGrads, dropout: Dropout) -> None:
    """Turn gradients by the splats after `dropout_fwd` into gradients by those before it, in place.

    Gradients of dropped splats are 0. Of `splats`, before or after `dropout_fwd`, only the depths are read.
    """
    n = len(v_splats.opacities)
    scalars = [n, dropout.gain, float(dropout.far)]
    device.launch("dropout", "dropout_bwd", (n,), [*scalars, splats.depths, v_splats.opacities])
