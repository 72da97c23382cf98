"""Gaussians along rays in float64: twin of cl/gaussian_rays.h and cl/composite_rays.h.

The squared distance of a ray from a Gaussian's centre, in standard deviations, is q/(lambda^2 + k q); the header
explains this. Here the three vectors b_i are the rows of a matrix B; B B^T is the covariance of (dx, dy, depth/z).
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import BLUR

Array = NDArray[np.float64]

OPEN_MIN, BORDER, WIDE_COS = 0.05, 8, 0.825
"""As in cl/gaussian_rays.h."""


def axes_around(n: Array) -> Array:
    """Orthonormal axes (..., 3, 3), in rows, whose last one is the unit vector n (..., 3)."""
    x, y, z = np.moveaxis(n, -1, 0)
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    rows = [
        [1 + sign * x * x * a, sign * x * y * a, -sign * x],
        [x * y * a, sign + y * y * a, -y],
        [x, y, z],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def ray_shape(f: dict[str, Any], camera: Camera) -> dict[str, Any]:
    """Shape of each Gaussian along rays, from `p`, `rotation`, `g` and `depths` of the projection `f`.

    Returns
    -------
    dict
        rows (N, 3, 3): j_0, j_1 and j_2; frame (N, 3, 3), axes of the chart, and focal (2,), its focal lengths, px;
        variance (N,), of the blur; wide (N, 3), the scales with the blur; root (N, 3, 3): B; conic (N, 3); slopes
        (N, 3): l and k; det0 and det (N,), determinants without and with the blur.
    """
    p, depths, n = f["p"], f["depths"], len(f["p"])
    if camera.model == "pinhole":
        frame, focal, at = np.tile(np.eye(3), (n, 1, 1)), np.array([camera.fx, camera.fy]), p
    else:
        frame = axes_around(p / depths[:, None])
        focal = np.full(2, np.sqrt(camera.fx * camera.fy))
        at = np.stack([0 * depths, 0 * depths, depths], axis=1)
    x, y, z = at.T
    o = 0 * z
    in_chart = [[focal[0] / z, o, -focal[0] * x / z**2], [o, focal[1] / z, -focal[1] * y / z**2], [o, o, 1 / z]]
    rows = np.moveaxis(np.array(in_chart), -1, 0) @ frame
    variance = BLUR * depths**2 / (camera.fx * camera.fy)
    scales = f["g"].scales
    wide = np.sqrt(scales**2 + variance[:, None])
    turned = rows @ camera.viewmat[:3, :3] @ f["rotation"]
    root = turned * wide[:, None, :]
    cov = root @ np.swapaxes(root, 1, 2)
    normal = np.cross(root[:, 0], root[:, 1])
    normal0 = np.cross(turned[:, 0] * scales, turned[:, 1] * scales)
    det, det0 = (normal**2).sum(axis=1), (normal0**2).sum(axis=1)
    conic = np.stack([cov[:, 1, 1], -cov[:, 0, 1], cov[:, 0, 0]], axis=1) / det[:, None]
    slopes = [
        -(np.cross(root[:, 1], normal) * root[:, 2]).sum(axis=1) / det,
        -(np.cross(normal, root[:, 0]) * root[:, 2]).sum(axis=1) / det,
        (normal * root[:, 2]).sum(axis=1) ** 2 / det,
    ]
    return dict(
        rows=rows, frame=frame, focal=focal, at=at, variance=variance, wide=wide, root=root, cov=cov, det0=det0,
        det=det, conic=conic, slopes=np.stack(slopes, axis=1),
    )  # fmt: skip


def ray_terms(shape: dict[str, Any], camera: Camera, means2d: Array) -> Array:
    """The rows `rays` of `clsplat.stages.RaySplats`."""
    if camera.model == "pinhole":
        return np.concatenate([means2d, shape["conic"], shape["slopes"]], axis=1)
    axes = shape["frame"] * np.array([*shape["focal"], 1.0])[:, None]
    n = len(means2d)
    return np.concatenate([np.zeros((n, 2)), shape["conic"], shape["slopes"], axes.reshape(n, 9)], axis=1)


def ray_outlines(f: dict[str, Any], shape: dict[str, Any], camera: Camera, r2: Array) -> tuple[Array, Array, Array]:
    """Centres (N, 2), half widths (N, 2) and conics (N, 3) of the regions in which D^2 <= r2; conic 0: a box."""
    if camera.model != "pinhole":
        return _boxes(f, shape, camera, r2)
    cov, size = shape["cov"], np.array([camera.width, camera.height])
    across, ahead = cov[:, [0, 1], [0, 1]], 1 - r2 * cov[:, 2, 2]
    r2, opened, lean = r2[:, None], ahead[:, None], r2[:, None] * cov[:, :2, 2]
    square = lean**2 + opened * r2 * across
    reach = np.abs(lean) + np.sqrt(np.maximum(square, 0))
    near = np.where(square < 0, 1e30, r2 * across / reach)
    far = np.where(opened > 0, reach / opened, 1e30)
    lo = np.maximum(f["means2d"] - np.where(lean < 0, near, far), -1)
    hi = np.minimum(f["means2d"] + np.where(lean < 0, far, near), size + 1)

    shift = -lean / opened
    outer = shift[:, :, None] * shift[:, None, :]
    ellipse = cov[:, :2, :2] / opened[:, :, None] + outer / r2[:, :, None]
    conic = np.linalg.inv(np.where(np.isfinite(ellipse).all(axis=(1, 2), keepdims=True), ellipse, np.eye(2)))
    closed = opened > OPEN_MIN
    centre = np.where(closed, f["means2d"] + shift, 0.5 * (lo + hi))
    extent = np.where(closed, np.sqrt(r2 * ellipse[:, [0, 1], [0, 1]]), 0.5 * (hi - lo))
    return centre, extent, np.where(closed, conic[:, [0, 0, 1], [0, 1, 1]], 0)


def _boxes(f: dict[str, Any], shape: dict[str, Any], camera: Camera, r2: Array) -> tuple[Array, Array, Array]:
    """Boxes around the images of points on the border of the cone of rays with D^2 <= r2; see cl/gaussian_rays.h."""
    view, n = camera.viewmat[:3, :3], len(r2)
    whiten = np.swapaxes(view @ f["rotation"], 1, 2) / shape["wide"][:, :, None]
    w = np.einsum("nij,nj->ni", whiten, f["p"])
    square = (w**2).sum(axis=1)
    around = axes_around(w / np.sqrt(square)[:, None])
    widths = 1.0824 * np.sqrt(r2 / (square - r2))
    turns = 2 * np.pi / BORDER * np.arange(BORDER)
    u = around[:, None, 2] + widths[:, None, None] * (
        np.cos(turns)[:, None] * around[:, None, 0] + np.sin(turns)[:, None] * around[:, None, 1]
    )
    d = np.einsum("nij,nj,nkj->nki", view @ f["rotation"], shape["wide"], u)
    length = np.linalg.norm(d, axis=2)
    least = np.minimum(1, ((d @ shape["frame"][:, 2, :, None])[:, :, 0] / length).min(axis=1))
    offset = _images(camera, d.reshape(-1, 3)).reshape(n, BORDER, 2) - f["means2d"][:, None]
    whole = ~(r2 < 0.9 * square) | (least < WIDE_COS)
    size, turn = np.array([camera.width, camera.height]), 2 * np.pi * camera.fx
    if camera.model == "equirectangular":
        offset[:, :, 0] -= turn * np.rint(offset[:, :, 0] / turn)
    else:
        whole |= (d[:, :, 2] < -0.85 * length).any(axis=1)
    grown = 1 + np.arccos(np.clip(least, -1, 1))
    lo = f["means2d"] + grown[:, None] * np.minimum(offset.min(axis=1), 0)
    hi = f["means2d"] + grown[:, None] * np.maximum(offset.max(axis=1), 0)
    if camera.model == "equirectangular":
        pole = whiten[:, :, 1]
        along = (around[:, 2] * pole).sum(axis=1)
        polar = (pole**2).sum(axis=1) - along**2 <= (1.5 * grown * widths * along) ** 2
        hi[polar & (along > 0), 1], lo[polar & (along < 0), 1] = camera.height + 1, -1
        seam = (lo[:, 0] < camera.cx - turn / 2) | (hi[:, 0] > camera.cx + turn / 2)
        wide = polar | seam | (hi[:, 0] - lo[:, 0] > turn / 2)
        lo[wide, 0], hi[wide, 0] = -1, camera.width + 1
    lo, hi = np.where(whole[:, None], -1, lo), np.where(whole[:, None], size + 1, hi)
    return 0.5 * (lo + hi), 0.5 * (hi - lo), np.zeros((n, 3))


def _images(camera: Camera, points: Array) -> Array:
    from clsplat.reference.lens import lens

    return np.asarray(lens(camera, points)["means2d"])


class ShapeGrads(NamedTuple):
    """Gradients of the shape and the centre of each Gaussian, and the camera's in part.

    log_scales (N, 3); rotation (N, 3, 3); p (N, 3), by the centre in the camera's frame, without the depth as a
    channel; view (3, 3), through the shape alone; intrinsics (4,), fx, fy, cx, cy.
    """

    log_scales: Array
    rotation: Array
    p: Array
    view: Array
    intrinsics: Array


def ray_bwd(f: dict[str, Any], camera: Camera, v: Any, v_dets: tuple[Array, Array]) -> ShapeGrads:
    """Gradients by `RayGrads`, and by det0 and det."""
    view, scales, wide, root, rows = camera.viewmat[:3, :3], f["g"].scales, f["wide"], f["root"], f["rows"]
    v_root, v_thin = ray_shape_bwd(f, v.conics, v.slopes, v_dets)
    # root = rows view rotation diag(wide), wide^2 = scales^2 + variance
    grown = (root * v_root).sum(axis=1)
    thin = root[:, :2] * (scales / wide)[:, None, :]
    v_variance = 0.5 * (grown / wide**2).sum(axis=1)
    v_scaled = v_root * wide[:, None, :]
    v_scaled[:, :2] += v_thin * scales[:, None, :]
    v_turned = v_scaled @ np.swapaxes(f["rotation"], 1, 2)

    v_rows = v_turned @ view.T @ np.swapaxes(f["frame"], 1, 2)  # of the chart
    (x, y, z), (fx, fy), (m_x, m_y) = f["at"].T, f["focal"], v.means2d.T
    v_x, v_y = fx * (m_x - v_rows[:, 0, 2] / z) / z, fy * (m_y - v_rows[:, 1, 2] / z) / z
    own = fx * v_rows[:, 0, 0] + fy * v_rows[:, 1, 1] + v_rows[:, 2, 2]
    v_z = -(v_x * x + v_y * y) / z - (own - (fx * x * v_rows[:, 0, 2] + fy * y * v_rows[:, 1, 2]) / z) / z**2
    v_p = np.einsum("ni,nij->nj", np.stack([v_x, v_y, v_z], axis=1), f["frame"])
    v_p += f["onward"] * (2 * v_variance * f["variance"] / f["depths"])[:, None]
    v_intrinsics = np.zeros(4)
    if camera.model == "pinhole":
        v_area = (v_variance * f["variance"]).sum()
        for i, focal in enumerate((fx, fy)):
            v_intrinsics[i] = (v.means2d[:, i] * f["at"][:, i] / z).sum()
            v_intrinsics[i] += ((v_rows[:, i] * rows[:, i]).sum() - v_area) / focal
        v_intrinsics[2:] = v.means2d.sum(axis=0)
    return ShapeGrads(
        log_scales=(scales / wide) ** 2 * grown + (thin * v_thin).sum(axis=1),
        rotation=view.T @ np.swapaxes(rows, 1, 2) @ v_scaled,
        p=v_p,
        view=np.einsum("nij,nik->jk", rows, v_turned),
        intrinsics=v_intrinsics,
    )


def ray_shape_bwd(
    shape: dict[str, Any], v_conics: Array, v_slopes: Array, v_dets: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Gradients with respect to B, (N, 3, 3), and those of det0 with respect to b_0 and b_1 without the blur."""
    q = shape["conic"][:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    v_q = (v_conics * [1, 0.5, 1])[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    c, (v_l, v_k) = shape["cov"][:, :2, 2], (v_slopes[:, :2], v_slopes[:, 2])
    # l = -Q c, k = var - c Q c
    v_q = v_q - v_l[:, :, None] * c[:, None, :] - v_k[:, None, None] * c[:, :, None] * c[:, None, :]
    v_q = 0.5 * (v_q + np.swapaxes(v_q, 1, 2))
    v_c = -np.einsum("nij,nj->ni", q, v_l + 2 * v_k[:, None] * c)
    v_cov = np.zeros_like(shape["cov"])
    v_cov[:, :2, :2] = -q @ v_q @ q
    v_cov[:, :2, 2] = v_cov[:, 2, :2] = 0.5 * v_c
    v_cov[:, 2, 2] = v_k
    v_root = 2 * v_cov @ shape["root"]
    v_root[:, :2] += _determinant_bwd(shape["root"], v_dets[1])
    thin = shape["root"] * (shape["g"].scales / shape["wide"])[:, None, :]
    return v_root, _determinant_bwd(thin, v_dets[0])


def _determinant_bwd(root: Array, v_det: Array) -> Array:
    """Gradients of |b_0 x b_1|^2 with respect to b_0 and b_1, (N, 2, 3)."""
    normal = np.cross(root[:, 0], root[:, 1])
    both = [np.cross(root[:, 1], normal), np.cross(normal, root[:, 0])]
    return 2 * v_det[:, None, None] * np.stack(both, axis=1)


def chart_offsets(row: Array, directions: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """dx, dy and along of the pixels at columns x and rows y in the chart of a splat with the terms `row`."""
    if len(row) == 8:
        return x + 0.5 - row[0], y + 0.5 - row[1], np.ones(np.broadcast_shapes(x.shape, y.shape))
    dx, dy, along = np.moveaxis(directions[y, x] @ row[8:].reshape(3, 3).T, -1, 0)
    return dx, dy, along


def ray_exponents(row: Array, offsets: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """sigma, and the factors r and h of its gradients (cl/composite_rays.h); sigma is infinite behind the camera."""
    (a, b, c, slope_x, slope_y, k), (dx, dy, along) = row[2:8], offsets
    q = a * dx**2 + 2 * b * dx * dy + c * dy**2
    level = along + slope_x * dx + slope_y * dy
    ahead = level > 1e-6
    below = np.where(ahead, level**2 + k * q, 1.0)
    return np.where(ahead, 0.5 * q / below, np.inf), np.where(ahead, q / below, 0), np.where(ahead, level / below, 0)


def ray_exponents_bwd(
    row: Array, offsets: tuple[Array, Array, Array], bend: tuple[Array, Array], v_sigma: Array
) -> tuple[Array, Array, Array]:
    """Gradients with respect to the centre in the chart (2,), Q (3,), and the slopes and k (3,)."""
    (dx, dy, along), (ratio, share), (a, b, c) = offsets, bend, row[2:5]
    v_half, v_level = v_sigma * share**2, -v_sigma * ratio * share
    v_x = v_half * (a * dx + b * dy) + v_level * row[5]
    v_y = v_half * (b * dx + c * dy) + v_level * row[6]
    return (
        -np.array([(along * v_x).sum(), (along * v_y).sum()]),
        np.array([(v_half * square).sum() for square in (0.5 * dx**2, dx * dy, 0.5 * dy**2)]),
        np.array([(v_level * dx).sum(), (v_level * dy).sum(), (-0.5 * v_sigma * ratio**2).sum()]),
    )
