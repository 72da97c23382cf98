"""Room for the cameras: Gaussians whose extents would reach a viewpoint are shrunk.

A large Gaussian beside a viewpoint, with a small depth, is projected to the whole image: affine projection divides
its size by its depth, and takes its slope from the edge of the image. Where no training photo looks in this
direction, training corrects nothing, and a new viewpoint sees nothing else (measured: docs/stability.md).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import ALPHA_MIN, FRUSTUM_MARGIN
from clsplat.dataset.near_planes import NEAR_SHARE
from clsplat.gaussians import Gaussians
from clsplat.reference.project import rotations

LEAST = 0.01
"""Smallest factor on the scales of a Gaussian. One whose centre is at a camera would otherwise have no size."""

TINY = 1e-300
"""Stands for a distance of 0 in a quotient."""

AT_ONCE = 1024
"""Gaussians whose distances to the viewpoints are computed at once, which bounds the memory."""

ROUNDING = 1e-6
"""Fraction by which the distance is enlarged up to which viewpoints are found."""

NEIGHBOURS = 4
"""Number of nearest cameras of each camera that are viewpoints together with it: those before and after it on a path,
and those of the paths beside it."""


def viewpoints(cameras: list[Camera]) -> NDArray[np.float64]:
    """Find positions from which a scene is looked at: those of the cameras, and the middle between neighbours.

    The middle counts if it is nearer to both cameras than the nearest points that they see: it is in free space.

    Parameters
    ----------
    cameras : list of Camera
        The training cameras, with near planes; at least one.

    Returns
    -------
    (C, 3) float64
        In world units.
    """
    from scipy.spatial import cKDTree

    places, rows = np.unique([camera.position for camera in cameras], axis=0, return_index=True)
    free = np.array([cameras[row].near or 0.0 for row in rows]) / NEAR_SHARE
    count = min(NEIGHBOURS + 1, len(places))
    distances, others = (found.reshape(len(places), -1) for found in cKDTree(places).query(places, k=count))
    first, nth = np.nonzero((distances > 0) & (distances / 2 < np.minimum(free[:, None], free[others])))
    middles = (places[first] + places[others[first, nth]]) / 2
    return np.unique(np.concatenate([places, middles]), axis=0)  # two neighbours have found the same middle


def steepest_slope(cameras: list[Camera]) -> float:
    """Find the largest slope at which affine projection takes its derivative, that of the corners of pinhole images.

    Cameras of other models have 1.
    """
    pinholes = [c for c in cameras if c.model == "pinhole"]
    corners = [np.hypot(c.width / c.fx, c.height / c.fy) / 2 for c in pinholes]
    return (1 + FRUSTUM_MARGIN) * float(max(corners)) if pinholes else 1.0


def room_factors(gaussians: Gaussians, positions: NDArray[np.float64], slope: float) -> NDArray[np.float64]:
    """Compute by what the scales of Gaussians must be multiplied so that no viewpoint beside one sees it.

    A Gaussian at a small depth z, at the distance d across the axis, has a splat with the standard deviation
    f/z (u'Su + slope^2 v'Sv)^(1/2), where u is the direction to the viewpoint, v is the axis, and S the covariance.
    Its centre is at f d/z. So it reaches the image, however small z is, unless

        d > r (u'Su + slope^2 s^2)^(1/2),

    with the largest scale s, and the standard deviations r at which alpha is ALPHA_MIN.

    Parameters
    ----------
    gaussians : Gaussians
        N, in world units.
    positions : (C, 3)
        Viewpoints, in world units; at least one.
    slope : float
        As from `steepest_slope`.

    Returns
    -------
    (N,)
        From `LEAST` to 1.
    """
    from scipy.spatial import cKDTree

    factors = np.ones(len(gaussians))
    means, scales = gaussians.means.astype(np.float64), gaussians.scales.astype(np.float64)
    reach = np.sqrt(2 * np.log(np.maximum(gaussians.opacities / ALPHA_MIN, 1.0)))  # in standard deviations
    largest = scales.max(axis=1)
    farthest = reach * np.hypot(1, slope) * largest  # beyond, no viewpoint has a quotient below 1
    tree = cKDTree(positions)
    nearest, _ = tree.query(means, workers=-1)
    rows = np.flatnonzero(farthest > nearest)
    for part in np.array_split(rows, -(-len(rows) // AT_ONCE)) if len(rows) else ():
        quats = gaussians.quats[part].astype(np.float64)
        axes = rotations(quats / np.linalg.norm(quats, axis=1, keepdims=True))
        found = tree.query_ball_point(means[part], (1 + ROUNDING) * farthest[part], return_sorted=False)
        counts = np.array([len(each) for each in found])
        of, row = np.repeat(np.arange(len(part)), counts), np.repeat(part, counts)
        offsets = np.einsum("pji,pj->pi", axes[of], positions[np.concatenate(found).astype(np.intp)] - means[row])
        distances = np.linalg.norm(offsets, axis=1)
        across = np.linalg.norm(offsets * scales[row], axis=1) / np.maximum(distances, TINY)
        needed = reach[row] * np.hypot(across, slope * largest[row])
        least = np.minimum.reduceat(distances / needed, np.cumsum(counts) - counts)
        factors[part] = np.clip(least, LEAST, 1.0)
    return factors


def with_room(gaussians: Gaussians, positions: NDArray[np.float64], slope: float) -> Gaussians:
    """Shrink the Gaussians that reach a viewpoint. Parameters as for `room_factors`."""
    change = np.log(room_factors(gaussians, positions, slope))[:, None]
    return replace(gaussians, log_scales=gaussians.log_scales + change.astype(gaussians.log_scales.dtype))
