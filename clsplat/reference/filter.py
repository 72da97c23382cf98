"""Twin of the stage filter: Mip-Splatting's 3D smoothing filter (Yu et al. 2024, equations 6 to 9)."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import FILTER_VARIANCE, FRUSTUM_MARGIN
from clsplat.gaussians import Gaussians, sigmoid
from clsplat.reference.lens import lens

Array = NDArray[np.float64]


def pixel_sizes(gaussians: Gaussians, cameras: Iterable[Camera]) -> Array:
    """Smallest size of a pixel at each Gaussian. Arguments and result as for `clsplat.ops.pixel_sizes`."""
    sizes = np.full(len(gaussians), np.inf)
    for camera in cameras:
        points = gaussians.means.astype(np.float64) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        with np.errstate(all="ignore"):
            f = lens(camera, points)
            within = np.abs(f["means2d"] / [camera.width, camera.height] - 0.5) <= 0.5 + 0.5 * FRUSTUM_MARGIN
            seen = f["seen"] & within.all(axis=1)
            reach = np.ones(len(points)) if camera.model == "orthographic" else f["depths"]
        sizes[seen] = np.minimum(sizes, reach / max(camera.fx, camera.fy))[seen]
    seen = np.isfinite(sizes)
    sizes[~seen] = sizes[seen].max(initial=0)
    return sizes


def filter_fwd(gaussians: Gaussians, pixels: Array) -> Gaussians:
    """Widen Gaussians. Arguments and result as for `clsplat.ops.filter_fwd`.

    The opacity is multiplied by a factor, so that odds = 1/opacity - 1 become ((1 + odds) - factor)/factor.
    """
    g = gaussians.astype(np.float64)
    with np.errstate(all="ignore"):
        variances = np.exp(2 * g.log_scales)
        wider = variances + FILTER_VARIANCE * np.asarray(pixels, np.float64)[:, None] ** 2
        factor = np.sqrt(np.prod(variances / wider, axis=1))
        logits = np.log(factor) - np.log(np.exp(-g.logit_opacities) + (1 - factor))
    alone = np.asarray(pixels) == 0
    return replace(
        g,
        log_scales=np.where(alone[:, None], g.log_scales, 0.5 * np.log(wider)),
        logit_opacities=np.where(alone, g.logit_opacities, logits),
    )


def filter_bwd(gaussians: Gaussians, pixels: Array, v: Gaussians) -> Gaussians:
    """Gradients of `filter_fwd`. Arguments and result as for `clsplat.ops.filter_bwd`."""
    after, g = filter_fwd(gaussians, pixels), gaussians.astype(np.float64)
    kept = np.exp(2 * (g.log_scales - after.log_scales))
    rest = sigmoid(-after.logit_opacities)  # 1 - opacity
    v_factor = (v.logit_opacities / rest)[:, None]
    v.log_scales[:] = v.log_scales * kept + v_factor * (1 - kept)
    v.logit_opacities[:] = v.logit_opacities * sigmoid(-g.logit_opacities) / rest
    return v
