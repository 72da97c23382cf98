"""Twin of the stage project: the equations of cl/project.cl in float64, vectorised over Gaussians.

Kerbl et al. 2023, equations 5 and 6, with the conventions of docs/conventions.md.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import (
    ALPHA_MIN,
    BLUR,
    COMPENSATION_MIN,
    EXTENT_SLACK,
    QUAT_NORM2_MIN,
)
from clsplat.gaussians import Gaussians, sigmoid
from clsplat.reference.adam import adam_step
from clsplat.reference.lens import lens
from clsplat.reference.sh import sh_basis, sh_basis_jacobian
from clsplat.stages import AdamStep, CameraGrads, SplatGrads, Splats

Array = NDArray[np.float64]


def rotations(quats: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions wxyz (..., 4)."""
    w, x, y, z = np.moveaxis(quats, -1, 0)
    entries = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(entries), (0, 1), (-2, -1))


def _rotation_jacobian(quats: Array) -> Array:
    """Derivatives d R_ij / d q_k of `rotations`, (..., 3, 3, 4). They are linear in q, since R is quadratic."""
    w, x, y, z = np.moveaxis(quats, -1, 0)
    o = np.zeros_like(w)
    by_quat = [
        [[o, -z, y], [z, o, -x], [-y, x, o]],
        [[o, y, z], [y, -2 * x, -w], [z, w, -2 * x]],
        [[-2 * y, x, w], [x, o, z], [-w, z, -2 * y]],
        [[-2 * z, -w, x], [w, -2 * z, y], [x, y, o]],
    ]
    return 2 * np.moveaxis(np.array(by_quat), (0, 1, 2), (-1, -3, -2))


def _forward(gaussians: Gaussians, camera: Camera, sh_degree: int) -> dict[str, Any]:
    """All intermediate quantities, for visible and invisible Gaussians."""
    g = gaussians.astype(np.float64)
    view, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    p = g.means @ view.T + translation
    seen = lens(camera, p)
    jacobian = seen["jacobian"]
    norm = np.linalg.norm(g.quats, axis=1)
    unit = g.quats / norm[:, None]
    rotation = rotations(unit)
    root = jacobian @ view @ rotation * g.scales[:, None, :]
    cov = root @ np.swapaxes(root, 1, 2)
    normal = np.cross(root[:, 0], root[:, 1])
    det0 = (normal**2).sum(axis=1)
    det = det0 + BLUR * (cov[:, 0, 0] + cov[:, 1, 1]) + BLUR**2

    offset = np.tile(view[2], (len(g), 1)) if camera.model == "orthographic" else g.means - camera.position
    basis = sh_basis(offset / np.linalg.norm(offset, axis=1, keepdims=True), sh_degree)
    color = 0.5 + np.einsum("nk,nkc->nc", basis, g.sh[:, : basis.shape[1]])
    return dict(
        g=g, p=p, norm=norm, unit=unit, rotation=rotation, root=root, cov=cov, det0=det0, det=det, offset=offset,
        basis=basis, color=color, **seen,
    )  # fmt: skip


def project_fwd(
    gaussians: Gaussians, camera: Camera, sh_degree: int, *, antialiased: bool = False, channels: int = 3
) -> Splats:
    """Project Gaussians into a camera. Arguments and result as for `clsplat.ops.project_fwd`."""
    with np.errstate(all="ignore"):  # invalid Gaussians are detected by their results
        f = _forward(gaussians, camera, sh_degree)
        opacities = sigmoid(f["g"].logit_opacities)
        if antialiased:
            opacities = opacities * np.sqrt(np.maximum(f["det0"] / f["det"], COMPENSATION_MIN**2))
        threshold = np.where(opacities > ALPHA_MIN, np.log(opacities / ALPHA_MIN) + EXTENT_SLACK, 0)
        cov = f["cov"] + BLUR * np.eye(2)
        extents = np.sqrt(2 * threshold[:, None] * np.stack([cov[:, 0, 0], cov[:, 1, 1]], axis=1))
        colors = np.maximum(f["color"], 0)
        if channels == 4:
            colors = np.concatenate([colors, f["depths"][:, None]], axis=1)
        conics = np.stack([cov[:, 1, 1], -cov[:, 0, 1], cov[:, 0, 0]], axis=1) / f["det"][:, None]

        # A Gaussian is visible only if the box contains a pixel centre of the image.
        size = np.array([camera.width, camera.height])
        first = np.ceil(np.clip(f["means2d"] - extents - 0.5, 0, size))
        last = np.floor(np.clip(f["means2d"] + extents - 0.5, -1, size - 1))
        norm2 = f["norm"] ** 2
        finite = np.isfinite(
            norm2
            + f["det"]
            + (f["means2d"] + extents).sum(axis=1)
            + f["color"].sum(axis=1)
            + f["p"].sum(axis=1)
            + f["depths"]
        )
        visible = finite & f["seen"] & (norm2 >= QUAT_NORM2_MIN) & (threshold > 0)
        visible &= (first <= last).all(axis=1)
    splats = Splats(f["means2d"], conics, f["depths"], extents, opacities, colors)
    return Splats(*(np.where(visible.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in splats))


def join_rows(first: Array, second: Array) -> Array:
    """Append rows to others. Arguments and result as for `clsplat.ops.join_rows`."""
    return np.concatenate([first, second])


def project_disparities(gaussians: Gaussians, camera: Camera, splats: Splats) -> Array:
    """Disparity along the rays of pixels. Arguments and result as for `clsplat.ops.project_disparities`.

    Image position and depth are jointly normal. Their covariance is root root^T, with a third row of root for the
    depth.
    """
    shown = splats.extents[:, 0] > 0
    f = _forward(gaussians.take(shown), camera, 0)
    z, (a, b, c) = f["depths"], splats.conics[shown].T
    depth_root = np.einsum("nj,jk,nkl->nl", f["onward"], camera.viewmat[:3, :3], f["rotation"]) * f["g"].scales
    xz, yz = np.einsum("nij,nj->in", f["root"], depth_root)
    result = np.zeros((len(gaussians), 3))
    result[shown] = np.stack([1 / z, -(a * xz + b * yz) / z**2, -(b * xz + c * yz) / z**2], axis=1)
    return result


def project_bwd(
    gaussians: Gaussians,
    camera: Camera,
    sh_degree: int,
    splats: Splats,
    v_splats: SplatGrads,
    *,
    antialiased: bool = False,
    camera_grad: bool = False,
) -> tuple[Gaussians, CameraGrads | None]:
    """Gradients of `project_fwd`. Arguments and result as for `clsplat.ops.project_bwd`."""
    shown = splats.extents[:, 0] > 0
    rows = gaussians.take(shown)
    f = _forward(rows, camera, sh_degree)
    v_means2d, v_conics, v_opacities, v_colors = (np.asarray(v, dtype=np.float64)[shown] for v in v_splats)
    view, g = camera.viewmat[:3, :3], f["g"]

    # conic = inverse of cov: v_cov = -Q V Q
    q = splats.conics[shown][:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    v = (v_conics * [1, 0.5, 1])[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    v_cov = -q @ v @ q
    opacities = sigmoid(g.logit_opacities)
    factor = np.ones_like(opacities)
    if antialiased:
        factor, v_compensated = _compensation_bwd(f, v_opacities * opacities)
        v_cov += v_compensated

    # cov = root root^T, root = jacobian view rotation diag(scales)
    v_root = 2 * v_cov @ f["root"]
    v_log_scales = (f["root"] * v_root).sum(axis=1)
    v_scaled = v_root * g.scales[:, None, :]
    v_rotation = view.T @ np.swapaxes(f["jacobian"], 1, 2) @ v_scaled
    v_unit = np.einsum("nij,nijk->nk", v_rotation, _rotation_jacobian(f["unit"]))
    v_quats = (v_unit - f["unit"] * (f["unit"] * v_unit).sum(axis=1, keepdims=True)) / f["norm"][:, None]
    v_turned = v_scaled @ np.swapaxes(f["rotation"], 1, 2)
    v_jacobian = v_turned @ view.T
    v_view = np.einsum("nij,nik->jk", f["jacobian"], v_turned)

    v_p = np.einsum("nij,ni->nj", f["slope_jacobian"], v_means2d)
    v_p += np.einsum("nijk,nij->nk", f["hessian"], v_jacobian)
    if v_colors.shape[1] == 4:
        v_p += f["onward"] * v_colors[:, 3:]

    v_color = np.where(f["color"] > 0, v_colors[:, :3], 0)
    v_offset = _direction_bwd(f, v_color, sh_degree)

    n = len(gaussians)
    result = Gaussians(
        np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4)), np.zeros(n), np.zeros(gaussians.sh.shape)
    )
    orthographic = camera.model == "orthographic"
    result.means[shown] = v_p @ view + (0 if orthographic else v_offset)
    result.log_scales[shown] = v_log_scales
    result.quats[shown] = v_quats
    result.logit_opacities[shown] = v_opacities * factor * opacities * (1 - opacities)
    v_sh = np.zeros((len(rows), *gaussians.sh.shape[1:]))
    v_sh[:, : f["basis"].shape[1]] = f["basis"][:, :, None] * v_color[:, None, :]
    result.sh[shown] = v_sh
    if not camera_grad:
        return result, None
    return result, _camera_bwd(f, camera, v_view + v_p.T @ g.means, v_p, v_offset, v_means2d, v_jacobian)


def _compensation_bwd(f: dict[str, Any], v_factor: Array) -> tuple[Array, Array]:
    """Compensation of the opacities for the blur, (N,), and its part in the gradients of the 2D covariances."""
    ratio = f["det0"] / f["det"]
    factor = np.sqrt(np.maximum(ratio, COMPENSATION_MIN**2))
    v_ratio = np.where(ratio > COMPENSATION_MIN**2, v_factor * 0.5 / factor, 0)
    adjugate0 = np.stack([f["cov"][:, 1, 1], -f["cov"][:, 0, 1], -f["cov"][:, 0, 1], f["cov"][:, 0, 0]], axis=1)
    adjugate0 = adjugate0.reshape(-1, 2, 2)
    adjugate = adjugate0 + BLUR * np.eye(2)
    return factor, (v_ratio / f["det"])[:, None, None] * (adjugate0 - ratio[:, None, None] * adjugate)


def _direction_bwd(f: dict[str, Any], v_color: Array, sh_degree: int) -> Array:
    """Gradients with respect to the offsets of the means from the camera, (N, 3), by the view dependence alone."""
    v_basis = np.einsum("nkc,nc->nk", f["g"].sh[:, : f["basis"].shape[1]], v_color)
    distance = np.linalg.norm(f["offset"], axis=1, keepdims=True)
    direction = f["offset"] / distance
    v_direction = np.einsum("nk,nkd->nd", v_basis, sh_basis_jacobian(direction, sh_degree))
    return (v_direction - direction * (direction * v_direction).sum(axis=1, keepdims=True)) / distance


def _camera_bwd(
    f: dict[str, Any],
    camera: Camera,
    v_rotation: Array,
    v_p: Array,
    v_offset: Array,
    v_means2d: Array,
    v_jacobian: Array,
) -> CameraGrads:
    """Gradients with respect to viewmat and intrinsics, from those by what depends on them."""
    v_viewmat = np.zeros((4, 4))
    v_viewmat[:3, :3] = v_rotation
    v_viewmat[:3, 3] = v_p.sum(axis=0)
    if camera.model == "orthographic":
        v_viewmat[2, :3] += v_offset.sum(axis=0)
    else:  # position = -view^-1 translation
        v_translation = -np.linalg.solve(camera.viewmat[:3, :3].T, -v_offset.sum(axis=0))
        v_viewmat[:3, :3] += np.outer(v_translation, camera.position)
        v_viewmat[:3, 3] += v_translation
    v_intrinsics = np.einsum("nic,ni->c", f["means2d_by"], v_means2d)
    v_intrinsics += np.einsum("nijc,nij->c", f["jacobian_by"], v_jacobian)
    return CameraGrads(v_viewmat, v_intrinsics)


def project_bwd_adam(
    gaussians: Gaussians,
    moments: tuple[Gaussians, Gaussians],
    camera: Camera,
    splats: Splats,
    v_splats: SplatGrads,
    step: AdamStep,
    *,
    antialiased: bool = False,
    camera_grad: bool = False,
) -> CameraGrads | None:
    """`project_bwd`, then `adam_step`. Arguments as for `clsplat.ops.project_bwd_adam`."""
    v, v_camera = project_bwd(
        gaussians, camera, step.sh_degree, splats, v_splats, antialiased=antialiased, camera_grad=camera_grad
    )
    adam_step(gaussians, v, *moments, step)
    return v_camera
