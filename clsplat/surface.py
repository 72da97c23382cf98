"""The surface in an image: depths and normals of the Gaussian that stops half of the light in each pixel."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, pixel_rays
from clsplat.gaussians import Gaussians
from clsplat.reference.project import rotations

Array = NDArray[np.float64]

FARTHEST = 10.0
"""Depth up to which a pixel shows the scene, as a factor on the depth that a quarter of the pixels do not reach. The
sky is farther, also where it fills most of the image."""


class Surface(NamedTuple):
    """The surface in an image of H x W pixels, by the Gaussian at which the transmittance falls to 1/2.

    Attributes
    ----------
    ids : (H, W) int32
        Index of this Gaussian; -1 where the transmittance stays above 1/2, or there is no depth.
    depth : (H, W) float64
        Median depth: where the pixel's ray has the largest density of this Gaussian, world units (z; distances for a
        fisheye and a panorama); 0 where there is none. The affine projection can draw a Gaussian in pixels whose rays
        would have its largest density behind the camera: these have no depth.
    normals : (H, W, 3) float64
        Unit vectors in world coordinates: the Gaussian's shortest axis, turned to the camera; 0 where there is none.
    """

    ids: NDArray[np.int32]
    depth: Array
    normals: Array


def scene_depth(depths: NDArray[np.floating]) -> float:
    """Largest depth that belongs to the scene and not to the sky; 0 for no depths.

    Parameters
    ----------
    depths : (P,)
        Depths of all pixels that have one.
    """
    return FARTHEST * float(np.quantile(depths, 0.25)) if len(depths) else 0.0


def surface_of(gaussians: Gaussians, camera: Camera, ids: NDArray[np.int32]) -> Surface:
    """Compute depths and normals of the surface from the indices of its Gaussians.

    The density along the ray t d is largest at t = (w . u)/(u . u) with w = L^-1 p, u = L^-1 d and L L^T the
    covariance. This is exact for every projection of the image.

    Parameters
    ----------
    gaussians : Gaussians
        On the host.
    camera : Camera
    ids : (H, W) int32
        Index of the Gaussian in each pixel, as `clsplat.ops.median_splats` finds it; -1 where there is none.

    Returns
    -------
    Surface
    """
    seen = ids >= 0
    unique, inverse = np.unique(ids[seen], return_inverse=True)
    g = gaussians.take(unique).astype(np.float64)
    view = camera.viewmat[:3, :3]
    points = g.means @ view.T + camera.viewmat[:3, 3]
    world_axes = rotations(g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True))
    # Scales of which the square is 0 have no inverse, and far below a millionth of the depth they change nothing.
    depths = np.linalg.norm(points, axis=1)
    scales = np.maximum(g.scales, 1e-6 * depths[:, None])
    whiten = np.swapaxes(view @ world_axes, 1, 2) / scales[:, :, None]

    origins, directions = np.zeros((len(inverse), 3)), pixel_rays(camera)[seen]
    if camera.model == "orthographic":
        v, u = np.nonzero(seen)
        origins[:, 0], origins[:, 1] = (u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy
    along = np.einsum("nij,nj->ni", whiten[inverse], directions)
    to_centre = np.einsum("nij,nj->ni", whiten[inverse], points[inverse] - origins)
    t = (along * to_centre).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
    ahead = t > 0
    depth, normals = np.zeros(ids.shape), np.zeros((*ids.shape, 3))
    depth[seen] = np.where(ahead, t * (directions[:, 2] if camera.model in ("pinhole", "orthographic") else 1), 0)

    shortest = np.take_along_axis(world_axes, scales.argmin(axis=1)[:, None, None], axis=2)[:, :, 0][inverse]
    away = (shortest * (directions @ view)).sum(axis=1, keepdims=True) > 0
    normals[seen] = np.where(away, -shortest, shortest) * ahead[:, None]
    return Surface(np.where(depth > 0, ids, np.int32(-1)), depth, normals)
