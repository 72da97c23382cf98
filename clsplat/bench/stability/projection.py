"""Experiments on projection: invalid parameters, needles, and wide angles."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat import reference
from clsplat.bench.stability.experiment import Experiment, Figure, Found, Plot
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.constants import ALPHA_MAX, ALPHA_MIN, BLUR, EXTENT_SLACK, NEAR
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.reference.project import rotations
from clsplat.render import render
from clsplat.stages import Image, Splats
from clsplat.testing import synthetic_scene

Array = NDArray[np.float64]

POISONS = (np.nan, np.inf, -np.inf, 0.0, 1e-40, 1e38, -1e38, 1e-38, 1 / 255)
"""Values that a bad step, a damaged file or a division can leave in a parameter."""

FIELDS_OF_VIEW = (20, 40, 60, 80, 100, 120, 140)
"""Fields of view across the image, degrees."""


def poisons() -> list[tuple[str, float]]:
    """All combinations of a field of Gaussians and a value of `POISONS`."""
    return [(field, value) for field in Gaussians.__dataclass_fields__ for value in POISONS]


def poisoned(field: str, value: float) -> tuple[Gaussians, Camera]:
    """A scene in which Gaussian 0, in the middle of the image, has the value in the first component of the field."""
    gaussians, camera = synthetic_scene(30, 1, width=48, height=32)
    gaussians.means[0] = 0
    scene = gaussians.astype(np.float32)
    getattr(scene, field).reshape(30, -1)[0, 0] = value
    return scene, camera


def harm(device: Device | None, field: str, value: float, config: RenderConfig) -> str:
    """Describe the effect of a poison outside its own Gaussian; an empty string if there is none."""
    scene, camera = poisoned(field, value)
    rendering = render(scene, camera, config, device, depth=True)
    v_rgb = np.random.default_rng(0).normal(size=rendering.rgb.shape)
    gradients = rendering.backward(v_rgb, viewmat_grad=True)
    arrays: dict[str, Any] = {"rgb": rendering.rgb, "alpha": rendering.alpha, "depth": rendering.depth}
    arrays |= {f"v_{k}": a for k, a in gradients.gaussians.arrays().items()} | {"v_viewmat": gradients.viewmat}
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            return f"{name} is not finite"
    alone = render(scene.take(np.array([0])), camera, config, device, gradients=False).alpha > 0
    others = render(scene.take(np.arange(1, 30)), camera, config, device, depth=True)
    if not np.array_equal(others.rgb[~alone], rendering.rgb[~alone]):
        return "pixels outside the Gaussian change"
    if not alone.any():
        clean = others.backward(v_rgb).gaussians
        for name, array in clean.arrays().items():
            if not np.array_equal(array, getattr(gradients.gaussians, name)[1:]):
                return f"v_{name} of other Gaussians changes"
    return ""


def _naive(field: str, value: float) -> bool:
    """Whether equations 5 and 6 of the paper, implemented literally in float32, yield a value that is not finite."""
    scene, camera = poisoned(field, value)
    with np.errstate(all="ignore"):
        g = scene.take(np.array([0]))
        view = camera.viewmat[:3, :3].astype(np.float32)
        x, y, z = (g.means @ view.T + camera.viewmat[:3, 3].astype(np.float32))[0]
        jacobian = np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]], np.float32) * np.float32(camera.fx)
        root = jacobian @ view @ rotations(g.quats / np.linalg.norm(g.quats))[0] * g.scales[0]
        cov = root @ root.T + np.float32(BLUR) * np.eye(2, dtype=np.float32)
        conic = cov / (cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2)
        outputs = [x / z, y / z, *conic.ravel(), *g.opacities, *g.sh[0, 0]]
    return not np.isfinite(outputs).all()


def _poisoning(device: Device) -> Found:
    configs = RenderConfig(), RenderConfig(mode="antialiased"), RenderConfig(sort="pixel")
    harmed = {(f, v) for f, v in poisons() for c in configs if harm(device, f, v, c)}
    return Found(
        [
            Figure("equations as they stand", float(sum(_naive(f, v) for f, v in poisons())), f"of {len(poisons())}"),
            Figure("tested before use", float(len(harmed)), f"of {len(poisons())}"),
        ]
    )


def _determinants(device: Device) -> Found:
    """Determinants of needles' covariances in float32, as xx yy - xy^2 and as a sum of positive terms."""
    rng = np.random.default_rng(0)
    lengths = 10.0 ** np.arange(0, 6)
    series: dict[str, list[tuple[float, float | None]]] = {"xx yy - xy^2": [], "|b0 x b1|^2 + blur": []}
    for length in lengths:
        angle, ratio = rng.uniform(0, 2 * np.pi, 20_000), rng.uniform(0, 1e-3, 20_000)
        b0 = np.stack([length * np.cos(angle), ratio * np.sin(angle)], axis=1)
        b1 = np.stack([length * np.sin(angle), -ratio * np.cos(angle)], axis=1)
        (xx, yy, xy), cross = (
            (a.astype(np.float64) for a in np.array([(b0**2).sum(1), (b1**2).sum(1), (b0 * b1).sum(1)])),
            b0[:, 0] * b1[:, 1] - b0[:, 1] * b1[:, 0],
        )
        exact = cross**2 + BLUR * (xx + yy) + BLUR**2
        single = [np.float32(a) for a in (xx, yy, xy, cross)]
        blur = np.float32(BLUR)
        plain = (single[0] + blur) * (single[1] + blur) - single[2] ** 2
        stable = single[3] ** 2 + blur * (single[0] + single[1]) + blur**2
        for label, found in zip(series, (plain, stable), strict=True):
            wrong = ~(np.abs(found / exact - 1) < 0.01)
            series[label].append((float(length), 100 * float(wrong.mean())))
    figures = [Figure(label, points[-1][1] or 0.0, "%") for label, points in series.items()]
    return Found(figures, Plot("length of the needle, px", "determinants off by more than 1 %, %", series, "x"))


def _jacobian(device: Device) -> Found:
    """Extents of a ball far outside the image, relative to those of the same ball on the axis.

    The ball measures 0.5 and lies just behind the near plane, at a slope x/z of 40, which is 40 half fields of view.
    """
    camera = Camera(np.eye(4), 50, 50, 50, 50, 100, 100)
    balls = synthetic_scene(2)[0]
    balls.means[:] = np.array([[0, 0, 1.0], [40, 0, 1]]) * 1.05 * NEAR
    balls.log_scales[:] = np.log(0.5)
    splats = reference.project_fwd(balls, camera, 0)
    # Without a limit the Jacobian's first row is f/z (1, 0, -x/z).
    free = np.hypot(1, balls.means[:, 0] / balls.means[:, 2])
    lengths = splats.extents[:, 0] / np.sqrt(2 * (np.log(balls.opacities / ALPHA_MIN) + EXTENT_SLACK))
    bounded = lengths[1] / lengths[0] if lengths[1] else 0.0
    return Found([Figure("no limit", float(free[1] / free[0])), Figure("slopes clamped", float(bounded))])


def shell(n: int) -> Gaussians:
    """Gaussians in all directions at distances of 2 to 6. Their size is about a tenth of their distance."""
    rng = np.random.default_rng(0)
    gaussians = synthetic_scene(n, sh_degree=0)[0]
    directions = rng.normal(size=(n, 3))
    distances = rng.uniform(2, 6, (n, 1))
    gaussians.means[:] = directions / np.linalg.norm(directions, axis=1, keepdims=True) * distances
    gaussians.log_scales[:] = np.log(distances) + rng.uniform(np.log(0.02), np.log(0.12), (n, 3))
    gaussians.logit_opacities[:] = 2
    return gaussians


def wide_camera(degrees: float, width: int = 120) -> Camera:
    """A camera at the origin that looks along z, with the given field of view across the image."""
    focal = 0.5 * width / np.tan(0.5 * np.radians(degrees))
    return Camera(np.eye(4), focal, focal, width / 2, width / 3, width, width * 2 // 3)


def ray_image(gaussians: Gaussians, camera: Camera) -> Image:
    """Render Gaussians by their maxima along the rays of pixels, without a projection, in the order of splats.

    Alpha is opacity exp(-D^2/2), where D is the smallest distance of the ray from the centre, in standard deviations.
    """
    g = gaussians.astype(np.float64)
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    points = g.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    axes = camera.viewmat[:3, :3] @ rotations(g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True))
    image, transmittance = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    colors = np.maximum(0.5 + 0.28209479177387814 * g.sh[:, 0], 0)
    order = np.argsort(points[:, 2])
    for i in order[points[order, 2] > -3 * g.scales[order].max(axis=1)]:  # the others are behind the camera
        whiten = axes[i] / g.scales[i]
        ray, centre = rays @ whiten, points[i] @ whiten
        along = ray @ centre
        squared = centre @ centre - along**2 / (ray**2).sum(axis=-1)
        alpha = np.minimum(g.opacities[i] * np.exp(-0.5 * squared), ALPHA_MAX)
        alpha = np.where((alpha >= ALPHA_MIN) & (along > 0), alpha, 0)
        image += (alpha * transmittance)[..., None] * colors[i]
        transmittance *= 1 - alpha
    return Image(image, 1 - transmittance)


def unscented_image(gaussians: Gaussians, camera: Camera) -> Image:
    """Render splats from the unscented transform: seven points of each Gaussian are projected exactly.

    Centre and covariance of a splat are weighted sums over these points (3DGUT, Wu et al. 2025, equations 5 to 9).
    """
    g = gaussians.astype(np.float64)
    axes = camera.viewmat[:3, :3] @ rotations(g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True))
    points = g.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    spread = 3.0  # alpha 1, kappa 0: sqrt(3) standard deviations, weights 1/6 and, for the centre, 0
    offsets = np.sqrt(spread) * np.swapaxes(axes * g.scales[:, None, :], 1, 2)
    sigma = np.concatenate([points[:, None] + offsets, points[:, None] - offsets], axis=1)
    seen: NDArray[np.bool_] = np.all(sigma[:, :, 2] > 0.05, axis=1)
    with np.errstate(all="ignore"):
        pixels = np.stack([camera.fx * sigma[..., 0] / sigma[..., 2], camera.fy * sigma[..., 1] / sigma[..., 2]], -1)
        pixels += [camera.cx, camera.cy]
    size = np.array([camera.width, camera.height])
    seen = seen & np.all(
        (pixels > -size) & (pixels < 2 * size), axis=(1, 2)
    )  # farther outside, the points do not represent the splat
    means = pixels.mean(axis=1)
    deviations = pixels - means[:, None]
    cov = np.einsum("nki,nkj->nij", deviations, deviations) / 6 + BLUR * np.eye(2)
    conics = np.linalg.inv(np.where(seen[:, None, None], cov, np.eye(2)))[:, [0, 0, 1], [0, 1, 1]]
    extents = np.sqrt(2 * (np.log(g.opacities / ALPHA_MIN) + EXTENT_SLACK)[:, None] * cov[:, [0, 1], [0, 1]])
    colors = np.maximum(0.5 + 0.28209479177387814 * g.sh[:, 0], 0)
    splats = Splats(means, conics, points[:, 2], np.where(seen[:, None], extents, 0), g.opacities, colors)
    splats = Splats(*(np.where(seen.reshape(-1, *[1] * (a.ndim - 1)), a, 0) for a in splats))
    bins = reference.bin_splats(splats, camera.width, camera.height, max(camera.width, camera.height))
    return reference.composite_fwd(splats, bins, np.zeros(3))


def _psnr(image: Array, truth: Array) -> float:
    return float(-10 * np.log10(((np.clip(image, 0, 1) - np.clip(truth, 0, 1)) ** 2).mean()))


def _wide_angle(device: Device) -> Found:
    scene = shell(600)
    series: dict[str, list[tuple[float, float | None]]] = {"affine": [], "along rays": [], "unscented": []}
    for degrees in FIELDS_OF_VIEW:
        camera = wide_camera(degrees)
        truth = ray_image(scene, camera).rgb
        affine, along = (
            render(scene.astype(np.float32), camera, RenderConfig(projection=projection), device, gradients=False).rgb
            for projection in ("affine", "ray")
        )
        images = {"affine": affine, "along rays": along, "unscented": unscented_image(scene, camera).rgb}
        for label, image in images.items():
            series[label].append((float(degrees), _psnr(image, truth)))
    figures = [Figure(f"{label}, 120 degrees", dict(points)[120.0] or 0.0, "dB") for label, points in series.items()]
    for label in ("affine", "along rays"):
        figures.append(Figure(f"{label}, 60 degrees", dict(series[label])[60.0] or 0.0, "dB"))
    return Found(figures, Plot("field of view, degrees", "PSNR against Gaussians along rays, dB", series))


POISONING = Experiment(
    failure="zero quaternions, NaN, infinities, denormals in any parameter",
    source="Brush's fuzz tests; one NaN spreads through a tile, its gradients through the scene",
    remedy="Gaussians with values that are not finite are not drawn, and have no gradient",
    test="tests/stability/test_projection.py::test_a_poison_harms_no_other_gaussian",
    measure=_poisoning,
    figure="combinations of five fields and nine values that affect the image, a gradient or another pixel",
)

NEEDLES = Experiment(
    failure="singular covariance of needles",
    source="xx yy - xy^2 cancels in float32; culling det < 1e-6 removes visible Gaussians",
    remedy="the determinant as a sum of positive terms (Lagrange's identity)",
    test="tests/stability/test_projection.py::test_needles_keep_their_determinant",
    measure=_determinants,
    figure="determinants off by more than 1 %, of needles 1e5 px long",
)

JACOBIAN = Experiment(
    failure="Jacobian outside the frustum and at the near plane",
    source="diff-gaussian-rasterization #75",
    remedy="slopes clamped to the enlarged image",
    test="tests/stability/test_projection.py::test_extents_stay_bounded_outside_the_image",
    measure=_jacobian,
    figure="extent of a ball 40 half images from the axis, relative to that of a ball on the axis; 0: not drawn",
)

WIDE_ANGLE = Experiment(
    failure="wide-angle projection error",
    source="3DGUT, Wu et al. 2025; Optimal Projection, Huang et al. 2024; 3DGEER, Huang et al. 2026",
    remedy="Gaussians evaluated along the pixels' rays (`--projection ray`)",
    test="tests/stability/test_projection.py::test_the_projection_along_rays_is_right_at_wide_angles",
    measure=_wide_angle,
    figure="PSNR against Gaussians evaluated along rays without blur; the unscented projection is a prototype",
)
