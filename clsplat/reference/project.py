"""Twin of the stage project: the equations of cl/project.cl in float64, vectorised over Gaussians.

Kerbl et al. 2023, equations 5 and 6, with the conventions of docs/conventions.md.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, pixel_rays
from clsplat.constants import (
    ALPHA_MIN,
    BLUR,
    COMPENSATION_MIN,
    EXTENT_SLACK,
    QUAT_NORM2_MIN,
)
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, sigmoid
from clsplat.reference.adam import adam_step
from clsplat.reference.gaussian_rays import ShapeGrads, ray_bwd, ray_outlines, ray_shape, ray_terms
from clsplat.reference.lens import lens
from clsplat.reference.sh import sh_basis, sh_basis_jacobian
from clsplat.stages import AdamStep, AnyGrads, AnySplats, CameraGrads, RaySplats, Splats

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


def _forward(gaussians: Gaussians, camera: Camera, sh_degree: int, rays: bool = False) -> dict[str, Any]:
    """All intermediate quantities, for visible and invisible Gaussians."""
    if camera.model == "equirectangular" and not rays:
        raise InputError("camera: expected a pinhole, orthographic or fisheye one, found an equirectangular one")
    g = gaussians.astype(np.float64)
    view, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    p = g.means @ view.T + translation
    seen = lens(camera, p)
    norm = np.linalg.norm(g.quats, axis=1)
    unit = g.quats / norm[:, None]
    rotation = rotations(unit)
    if rays:
        shape = ray_shape(dict(g=g, p=p, rotation=rotation, depths=seen["depths"]), camera)
    else:
        root = seen["jacobian"] @ view @ rotation * g.scales[:, None, :]
        cov = root @ np.swapaxes(root, 1, 2)
        normal = np.cross(root[:, 0], root[:, 1])
        det0 = (normal**2).sum(axis=1)
        shape = dict(root=root, cov=cov, det0=det0, det=det0 + BLUR * (cov[:, 0, 0] + cov[:, 1, 1]) + BLUR**2)

    offset = np.tile(view[2], (len(g), 1)) if camera.model == "orthographic" else g.means - camera.position
    basis = sh_basis(offset / np.linalg.norm(offset, axis=1, keepdims=True), sh_degree)
    color = 0.5 + np.einsum("nk,nkc->nc", basis, g.sh[:, : basis.shape[1]])
    return dict(
        g=g, p=p, norm=norm, unit=unit, rotation=rotation, offset=offset, basis=basis, color=color, **seen, **shape,
    )  # fmt: skip


def project_fwd(
    gaussians: Gaussians,
    camera: Camera,
    sh_degree: int,
    *,
    antialiased: bool = False,
    channels: int = 3,
    rays: bool = False,
    gain: float = 1.0,
) -> AnySplats:
    """Project Gaussians into a camera. Arguments and result as for `clsplat.ops.project_fwd`."""
    with np.errstate(all="ignore"):  # invalid Gaussians are detected by their results
        f = _forward(gaussians, camera, sh_degree, rays)
        opacities = sigmoid(f["g"].logit_opacities)
        if antialiased:
            opacities = opacities * np.sqrt(np.maximum(f["det0"] / f["det"], COMPENSATION_MIN**2))
        drawn = gain * opacities if rays else opacities
        threshold = np.where(drawn > ALPHA_MIN, np.log(drawn / ALPHA_MIN) + EXTENT_SLACK, 0)
        if rays:
            means2d, extents, conics = ray_outlines(f, f, camera, 2 * threshold)
        else:
            means2d, cov = f["means2d"], f["cov"] + BLUR * np.eye(2)
            extents = np.sqrt(2 * threshold[:, None] * np.stack([cov[:, 0, 0], cov[:, 1, 1]], axis=1))
            conics = np.stack([cov[:, 1, 1], -cov[:, 0, 1], cov[:, 0, 0]], axis=1) / f["det"][:, None]
        colors = np.maximum(f["color"], 0)
        if channels == 4:
            colors = np.concatenate([colors, f["depths"][:, None]], axis=1)

        # A Gaussian is visible only if the box contains a pixel centre of the image.
        size = np.array([camera.width, camera.height])
        first = np.ceil(np.clip(means2d - extents - 0.5, 0, size))
        last = np.floor(np.clip(means2d + extents - 0.5, -1, size - 1))
        norm2 = f["norm"] ** 2
        finite = np.isfinite(
            norm2
            + f["det"]
            + (means2d + extents).sum(axis=1)
            + f["color"].sum(axis=1)
            + f["p"].sum(axis=1)
            + f["depths"]
        )
        visible = finite & f["seen"] & (norm2 >= QUAT_NORM2_MIN) & (threshold > 0)
        visible &= (first <= last).all(axis=1)
        splats = [means2d, conics, f["depths"], extents, opacities, colors]
        if rays:
            splats.append(ray_terms(f, camera, f["means2d"]))
            visible &= np.isfinite(conics.sum(axis=1) + f["slopes"].sum(axis=1))
    shown = [np.where(visible.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0) for a in splats]
    if not rays:
        return Splats(*shown)
    directions = np.zeros((1, 1, 3)) if camera.model == "pinhole" else pixel_rays(camera)
    return RaySplats(*[*shown, directions])


def join_rows(first: Array, second: Array) -> Array:
    """Append rows to others. Arguments and result as for `clsplat.ops.join_rows`."""
    return np.concatenate([first, second])


def project_disparities(gaussians: Gaussians, camera: Camera, splats: AnySplats) -> Array:
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
    splats: AnySplats,
    v_splats: AnyGrads,
    *,
    antialiased: bool = False,
    camera_grad: bool = False,
) -> tuple[Gaussians, CameraGrads | None]:
    """Gradients of `project_fwd`. Arguments and result as for `clsplat.ops.project_bwd`."""
    shown = splats.extents[:, 0] > 0
    rows = gaussians.take(shown)
    along_rays = isinstance(splats, RaySplats)
    f = _forward(rows, camera, sh_degree, along_rays)
    v = v_splats._replace(**{name: np.asarray(a, dtype=np.float64)[shown] for name, a in v_splats._asdict().items()})
    g, opacities = f["g"], sigmoid(f["g"].logit_opacities)
    factor, v_dets = np.ones_like(opacities), (np.zeros_like(opacities),) * 2
    if antialiased:
        factor, v_dets = _compensation_bwd(f, v.opacities * opacities)
    part = ray_bwd(f, camera, v, v_dets) if along_rays else _affine_bwd(f, camera, splats.conics[shown], v, v_dets)

    v_unit = np.einsum("nij,nijk->nk", part.rotation, _rotation_jacobian(f["unit"]))
    v_quats = (v_unit - f["unit"] * (f["unit"] * v_unit).sum(axis=1, keepdims=True)) / f["norm"][:, None]
    v_p = part.p
    if v.colors.shape[1] == 4:
        v_p = v_p + f["onward"] * v.colors[:, 3:]
    v_color = np.where(f["color"] > 0, v.colors[:, :3], 0)
    v_offset = _direction_bwd(f, v_color, sh_degree)

    n = len(gaussians)
    result = Gaussians(
        np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4)), np.zeros(n), np.zeros(gaussians.sh.shape)
    )
    orthographic = camera.model == "orthographic"
    result.means[shown] = v_p @ camera.viewmat[:3, :3] + (0 if orthographic else v_offset)
    result.log_scales[shown] = part.log_scales
    result.quats[shown] = v_quats
    result.logit_opacities[shown] = v.opacities * factor * opacities * (1 - opacities)
    v_sh = np.zeros((len(rows), *gaussians.sh.shape[1:]))
    v_sh[:, : f["basis"].shape[1]] = f["basis"][:, :, None] * v_color[:, None, :]
    result.sh[shown] = v_sh
    if not camera_grad:
        return result, None
    v_viewmat = _viewmat_bwd(camera, part.view + v_p.T @ g.means, v_p, v_offset)
    return result, CameraGrads(v_viewmat, part.intrinsics)


def _affine_bwd(
    f: dict[str, Any], camera: Camera, conics: Array, v: AnyGrads, v_dets: tuple[Array, Array]
) -> ShapeGrads:
    """Gradients of the shape and the centre in the affine approximation."""
    # conic = inverse of cov: v_cov = -Q V Q
    q = conics[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    v_cov = -q @ (v.conics * [1, 0.5, 1])[:, [0, 1, 1, 2]].reshape(-1, 2, 2) @ q
    v_det0, v_det = (v_det[:, None, None] for v_det in v_dets)
    v_cov += v_det0 * _adjugate(f["cov"]) + v_det * _adjugate(f["cov"] + BLUR * np.eye(2))

    # cov = root root^T, root = jacobian view rotation diag(scales)
    view, g = camera.viewmat[:3, :3], f["g"]
    v_root = 2 * v_cov @ f["root"]
    v_scaled = v_root * g.scales[:, None, :]
    v_turned = v_scaled @ np.swapaxes(f["rotation"], 1, 2)
    v_jacobian = v_turned @ view.T
    v_p = np.einsum("nij,ni->nj", f["slope_jacobian"], v.means2d)
    v_p += np.einsum("nijk,nij->nk", f["hessian"], v_jacobian)
    v_intrinsics = np.einsum("nic,ni->c", f["means2d_by"], v.means2d)
    v_intrinsics += np.einsum("nijc,nij->c", f["jacobian_by"], v_jacobian)
    return ShapeGrads(
        log_scales=(f["root"] * v_root).sum(axis=1),
        rotation=view.T @ np.swapaxes(f["jacobian"], 1, 2) @ v_scaled,
        p=v_p,
        view=np.einsum("nij,nik->jk", f["jacobian"], v_turned),
        intrinsics=v_intrinsics,
    )


def _compensation_bwd(f: dict[str, Any], v_factor: Array) -> tuple[Array, tuple[Array, Array]]:
    """Compensation of the opacities for the blur, (N,), and the gradients with respect to det0 and det."""
    ratio = f["det0"] / f["det"]
    factor = np.sqrt(np.maximum(ratio, COMPENSATION_MIN**2))
    v_ratio = np.where(ratio > COMPENSATION_MIN**2, v_factor * 0.5 / factor, 0)
    return factor, (v_ratio / f["det"], -v_ratio * ratio / f["det"])


def _adjugate(cov: Array) -> Array:
    """Adjugates of symmetric matrices (N, 2, 2): the derivatives of their determinants."""
    entries = [cov[:, 1, 1], -cov[:, 0, 1], -cov[:, 0, 1], cov[:, 0, 0]]
    return np.stack(entries, axis=1).reshape(-1, 2, 2)


def _direction_bwd(f: dict[str, Any], v_color: Array, sh_degree: int) -> Array:
    """Gradients with respect to the offsets of the means from the camera, (N, 3), by the view dependence alone."""
    v_basis = np.einsum("nkc,nc->nk", f["g"].sh[:, : f["basis"].shape[1]], v_color)
    distance = np.linalg.norm(f["offset"], axis=1, keepdims=True)
    direction = f["offset"] / distance
    v_direction = np.einsum("nk,nkd->nd", v_basis, sh_basis_jacobian(direction, sh_degree))
    return (v_direction - direction * (direction * v_direction).sum(axis=1, keepdims=True)) / distance


def _viewmat_bwd(camera: Camera, v_rotation: Array, v_p: Array, v_offset: Array) -> Array:
    """Gradient with respect to viewmat, from those by what depends on it."""
    v_viewmat = np.zeros((4, 4))
    v_viewmat[:3, :3] = v_rotation
    v_viewmat[:3, 3] = v_p.sum(axis=0)
    if camera.model == "orthographic":
        v_viewmat[2, :3] += v_offset.sum(axis=0)
    else:  # position = -view^-1 translation
        v_translation = -np.linalg.solve(camera.viewmat[:3, :3].T, -v_offset.sum(axis=0))
        v_viewmat[:3, :3] += np.outer(v_translation, camera.position)
        v_viewmat[:3, 3] += v_translation
    return v_viewmat


def project_bwd_adam(
    gaussians: Gaussians,
    moments: tuple[Gaussians, Gaussians],
    camera: Camera,
    splats: AnySplats,
    v_splats: AnyGrads,
    step: AdamStep,
    *,
    antialiased: bool = False,
    camera_grad: bool = False,
) -> CameraGrads | None:
    """`project_bwd`, then `adam_step`. Arguments as for `clsplat.ops.project_bwd_adam`."""
    v, v_camera = project_bwd(
        gaussians, camera, step.sh_degree, splats, v_splats, antialiased=antialiased, camera_grad=camera_grad
    )
    adam_step(gaussians, v, *moments, step, splats.extents)
    return v_camera
