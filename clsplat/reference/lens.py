"""Camera models in float64: twin of cl/lens.h."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import FRUSTUM_MARGIN

Array = NDArray[np.float64]

AXIS = 1e-3
"""Largest rho/z at which the derivatives of a fisheye come from the power series. There, cancellation loses more
digits than the truncation of the series, O((rho/z)^6)."""


def lens(camera: Camera, points: Array, *, derivatives: bool = True) -> dict[str, Any]:
    """Image positions of points (N, 3) in the camera's frame, with derivatives to second order.

    Parameters
    ----------
    camera : Camera
    points : (N, 3) array
    derivatives : bool
        False to leave out what only derivatives need: jacobian to jacobian_by below.

    Returns
    -------
    dict
        means2d (N, 2) px; jacobian (N, 2, 3) of the local affine approximation; hessian (N, 2, 3, 3), the derivative
        of jacobian by the point; slope_jacobian (N, 2, 3), the derivative of means2d, which differs from jacobian
        where that of a pinhole is clamped; means2d_by (N, 2, 4) and jacobian_by (N, 2, 3, 4), the derivatives by fx,
        fy, cx, cy; depths (N,), and onward (N, 3), their gradient; seen (N,) bool, False for culled points. Without
        derivatives for an equirectangular camera.
    """
    if camera.model == "equirectangular":
        return _sphere(camera, points)
    n, focal = len(points), np.array([camera.fx, camera.fy])
    x, y, z = points.T
    depths, onward, seen = z, np.broadcast_to([0.0, 0.0, 1.0], (n, 3)), z > camera.near_depth
    if camera.model == "orthographic":
        slopes = points[:, :2]
    elif camera.model == "fisheye":
        depths = np.linalg.norm(points, axis=1)
        onward, seen = (
            points / depths[:, None],
            (depths > camera.near_depth) & (np.arctan2(np.hypot(x, y), z) < camera.angle_max),
        )
        s, gradient, second = _radial(camera, points)
        # (x s)_jk = e_j s_k + e_k s_j + x s_jk, and the same for y
        slopes = points[:, :2] * s[:, None]
    else:
        slopes = points[:, :2] / z[:, None]
    found = dict(means2d=slopes * focal + [camera.cx, camera.cy], depths=depths, onward=onward, seen=seen)
    if not derivatives:
        return found

    hessian, means2d_by, jacobian_by = np.zeros((n, 2, 3, 3)), np.zeros((n, 2, 4)), np.zeros((n, 2, 3, 4))
    means2d_by[:, [0, 1], [2, 3]] = 1
    if camera.model == "orthographic":
        slope_jacobian = np.tile(np.eye(2, 3), (n, 1, 1))
    elif camera.model == "fisheye":
        across = np.eye(2, 3)
        slope_jacobian = across * s[:, None, None] + points[:, :2, None] * gradient[:, None]
        hessian = (
            across[None, :, :, None] * gradient[:, None, None] + across[None, :, None] * gradient[:, None, :, None]
        )
        hessian = focal[:, None, None] * (hessian + points[:, :2, None, None] * second[:, None])
    else:
        slope_jacobian = np.zeros((n, 2, 3))
        slope_jacobian[:, [0, 1], [0, 1]] = 1 / z[:, None]
        slope_jacobian[:, :, 2] = -slopes / z[:, None]
    jacobian = focal[:, None] * slope_jacobian
    means2d_by[:, [0, 1], [0, 1]] = slopes
    jacobian_by[:, [0, 1], :, [0, 1]] = np.swapaxes(slope_jacobian, 0, 1)
    if camera.model == "pinhole":
        # Where the clamp acts, -f slope/z is -f limit/z, in which f limit is c +- a constant.
        size, centre = np.array([camera.width, camera.height]), np.array([camera.cx, camera.cy])
        margin = FRUSTUM_MARGIN * 0.5 * size
        clamped = np.clip(slopes, (-centre - margin) / focal, (size - centre + margin) / focal)
        free = clamped == slopes
        jacobian[:, :, 2] = -focal * clamped / z[:, None]
        for i in range(2):
            hessian[:, i, i, 2] = -focal[i] / z**2
            hessian[:, i, 2, i] = np.where(free[:, i], -focal[i] / z**2, 0)
            hessian[:, i, 2, 2] = np.where(free[:, i], 2, 1) * focal[i] * clamped[:, i] / z**2
            jacobian_by[:, i, 2, i] = np.where(free[:, i], -slopes[:, i] / z, 0)
            jacobian_by[:, i, 2, 2 + i] = np.where(free[:, i], 0, 1 / z)
    return found | dict(
        jacobian=jacobian, hessian=hessian, slope_jacobian=focal[:, None] * slope_jacobian, means2d_by=means2d_by,
        jacobian_by=jacobian_by,
    )  # fmt: skip


def _sphere(camera: Camera, points: Array) -> dict[str, Any]:
    """Image positions, depths and visibility for an equirectangular camera, which projects along rays alone."""
    x, y, z = points.T
    depths = np.linalg.norm(points, axis=1)
    angles = np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=1)
    return dict(
        means2d=angles * [camera.fx, camera.fy] + [camera.cx, camera.cy], depths=depths,
        onward=points / depths[:, None], seen=depths > camera.near_depth,
    )  # fmt: skip


def _radial(camera: Camera, points: Array) -> tuple[Array, Array, Array]:
    """theta_d/rho of a fisheye (N,), its gradient (N, 3) and its second derivatives (N, 3, 3)."""
    x, y, z = points.T
    powers = np.polynomial.Polynomial([0, 1, 0, camera.distortion[0], 0, camera.distortion[1], 0,
                                       camera.distortion[2], 0, camera.distortion[3]])  # fmt: skip
    rho, r2 = np.hypot(x, y), (points**2).sum(axis=1)
    theta = np.arctan2(rho, z)
    d, d1, d2 = powers(theta), powers.deriv()(theta), powers.deriv(2)(theta)
    # theta_rho = z/r^2, theta_z = -rho/r^2
    s = d / rho
    s_rho = d1 * z / r2 / rho - d / rho**2
    d_rho_rho = d2 * (z / r2) ** 2 - d1 * 2 * rho * z / r2**2
    s_rho_rho = d_rho_rho / rho - 2 * s_rho / rho
    s_z = -d1 / r2
    s_zz = (d2 * rho + 2 * d1 * z) / r2**2
    s_rho_z = (2 * d1 * rho - d2 * z) / r2**2
    by_rho = s_rho / rho
    curvature = (s_rho_rho - by_rho) / rho**2
    mixed = s_rho_z / rho

    # theta_d/rho = (1 + a t + b t^2 + c t^3)/z with t = (rho/z)^2, from the series of the arc tangent
    k1, k2, k3, _ = camera.distortion
    a, b, c = k1 - 1 / 3, k2 - k1 + 1 / 5, k3 - 5 / 3 * k2 + 14 / 15 * k1 - 1 / 7
    t = (rho / z) ** 2
    near = (z > 0) & (t < AXIS**2)
    s = np.where(near, (1 + a * t + b * t**2 + c * t**3) / z, s)
    by_rho = np.where(near, (2 * a + 4 * b * t + 6 * c * t**2) / z**3, by_rho)
    curvature = np.where(near, (8 * b + 24 * c * t) / z**5, curvature)
    mixed = np.where(near, -(6 * a + 20 * b * t + 42 * c * t**2) / z**4, mixed)

    gradient = np.stack([x * by_rho, y * by_rho, s_z], axis=1)
    second = np.zeros((len(points), 3, 3))
    second[:, :2, :2] = by_rho[:, None, None] * np.eye(2)
    second[:, :2, :2] += curvature[:, None, None] * points[:, :2, None] * points[:, None, :2]
    second[:, :2, 2] = second[:, 2, :2] = mixed[:, None] * points[:, :2]
    second[:, 2, 2] = s_zz
    return s, gradient, second
