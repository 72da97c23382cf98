"""Bounds of the Gaussians that photos may show. Only these are read from a scene that does not fit the memory."""

from collections.abc import Iterable
from math import log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.constants import ALPHA_MIN, BLUR, EXTENT_SLACK, FRUSTUM_MARGIN
from clsplat.gaussians import Gaussians
from clsplat.renderer import along_rays

Array = NDArray[np.float64]

DEVIATIONS = sqrt(2 * (log(1 / ALPHA_MIN) + EXTENT_SLACK))
"""Standard deviations from the centre of an opaque Gaussian up to which it is drawn."""

ROUNDING = 1e-5
"""Error of a position in single precision, as a fraction of the largest coordinate: some hundred roundings."""

PIXEL = 1
"""Pixels by which an image is enlarged, for roundings in the image."""


class Bounds(NamedTuple):
    """Boxes around Gaussians, world units.

    low, high (N, 3): around what is drawn of them; radius (N,): largest standard deviation.
    """

    low: Array
    high: Array
    radius: Array

    @classmethod
    def of(cls, gaussians: Gaussians) -> "Bounds":
        """A box around each Gaussian."""
        with np.errstate(over="ignore"):  # a Gaussian of infinite size is in an infinite box
            radius = np.exp(gaussians.log_scales.max(axis=1).astype(np.float64))
        means, reach = gaussians.means.astype(np.float64), DEVIATIONS * radius[:, None]
        return cls(means - reach, means + reach, radius)

    def take(self, rows: NDArray[np.bool_] | slice) -> "Bounds":
        """Some of the boxes."""
        return Bounds(self.low[rows], self.high[rows], self.radius[rows])


def looking_at(cameras: Iterable[Camera], bounds: Bounds, config: RenderConfig) -> NDArray[np.bool_]:
    """Whether each of C cameras may show something in each of N boxes, (C, N)."""
    rows = [may_see(camera, bounds, config) for camera in cameras]
    return np.array(rows, bool).reshape(len(rows), len(bounds.radius))


def seen(cameras: Iterable[Camera], bounds: Bounds, config: RenderConfig) -> NDArray[np.bool_]:
    """Whether a photo of any camera may show something in each box, (N,)."""
    found = np.zeros(len(bounds.radius), bool)
    for camera in cameras:
        left = ~found
        found[left] = may_see(camera, bounds.take(left), config)
    return found


def may_see(camera: Camera, bounds: Bounds, config: RenderConfig) -> NDArray[np.bool_]:
    """Whether a camera may show something in each box.

    Parameters
    ----------
    camera : Camera
    bounds : Bounds
        N boxes.
    config : RenderConfig
        How they are drawn.

    Returns
    -------
    (N,) bool
        False only where nothing in the box is drawn, whatever its shape, opacity and near plane. An equirectangular
        camera looks in all directions, and may show everything.
    """
    with np.errstate(invalid="ignore"):  # infinite boxes; comparisons with NaN must not cull
        if camera.model == "fisheye":
            return _in_cone(camera, bounds)
        if camera.model == "equirectangular":
            return np.ones(len(bounds.radius), bool)
        return _in_frustum(camera, bounds, along_rays(config, camera))


def _in_frustum(camera: Camera, bounds: Bounds, rays: bool) -> NDArray[np.bool_]:
    """Whether boxes reach over the four planes through the image borders, and before the camera.

    X is the position across the image, Z the depth, s the largest standard deviation, k `DEVIATIONS`. A Gaussian
    reaches over the border at slope m of a pinhole only if

        f X <= f m Z + k (f sqrt(1 + c^2) s + sqrt(BLUR) Z)             for an affine splat
        X <= m Z + k sqrt(1 + m^2) (s + sqrt(BLUR / (fx fy)) Z)         along rays

    and over the border of an orthographic image of half the width w only if f X <= w + k (f s + sqrt(BLUR)). c is the
    slope of the Jacobian, which is clamped at FRUSTUM_MARGIN beyond the border (cl/lens.h). Along rays, the point in
    front of the camera where the density is largest is on a ray through the image, and at most k of the deviations
    from the centre, whose squares the blur increases by BLUR Z^2 / (fx fy) (cl/gaussian_rays.h).
    """
    view, moved = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    error = ROUNDING * (np.maximum(-bounds.low, bounds.high).max(axis=1) + np.abs(moved).max())
    result = ~(_least(-view[2], bounds) - moved[2] > error)
    intrinsics = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    for axis, (focal, centre, size) in enumerate(intrinsics):
        for sign, room in ((1, size - centre), (-1, centre)):
            slope, shift, length = (room + PIXEL + DEVIATIONS * sqrt(BLUR)) / focal, 0.0, 1.0
            if camera.model == "orthographic":
                slope, shift = 0.0, slope
            elif rays:
                border = (room + PIXEL) / focal
                length = sqrt(1 + border**2)
                slope = border + DEVIATIONS * length * sqrt(BLUR / (camera.fx * camera.fy))
            else:
                steepest = max(abs(slope), abs(room + FRUSTUM_MARGIN * 0.5 * size) / focal)
                length = sqrt(1 + steepest**2)
            normal = np.array([0.0, 0.0, -slope])
            normal[axis] = sign
            # The box already reaches DEVIATIONS radii over the mean along any direction.
            more = DEVIATIONS * max(0.0, length - sqrt(1 + slope**2)) * bounds.radius
            distance = _least(normal @ view, bounds) + normal @ moved - shift
            result &= ~(distance > more + (1 + abs(slope)) * error)
    return result


def _least(normal: Array, bounds: Bounds) -> Array:
    """Least products of a vector (3,) and the points of boxes, (N,)."""
    corner = [(bounds.low if sign > 0 else bounds.high)[:, axis] for axis, sign in enumerate(normal)]
    return np.asarray(normal[0] * corner[0] + normal[1] * corner[1] + normal[2] * corner[2])


def _in_cone(camera: Camera, bounds: Bounds) -> NDArray[np.bool_]:
    """Whether spheres around boxes reach into the cone in which a fisheye draws centres (cl/lens.h)."""
    middle, radius = (bounds.low + bounds.high) / 2, np.linalg.norm(bounds.high - bounds.low, axis=1) / 2
    x, y, z = (middle @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).T
    distance = np.sqrt(x**2 + y**2 + z**2)
    radius = radius + ROUNDING * (np.abs(middle).max(axis=1) + np.abs(camera.viewmat[:3, 3]).max())
    width = np.arcsin(np.minimum(1, radius / np.maximum(distance, np.finfo(float).tiny)))
    outside = np.arctan2(np.hypot(x, y), z) - width > camera.angle_max + ROUNDING
    return ~(outside & (radius < distance))
