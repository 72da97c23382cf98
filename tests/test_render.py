"""The renderer: device against twins, gradients by central differences, invariances, degenerate scenes."""

from dataclasses import replace

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.constants import NEAR
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.reference.project import rotations
from clsplat.render import render
from clsplat.testing import ambiguous_pixels, assert_matches, gradcheck, synthetic_scene, threshold_distances

MODES = pytest.mark.parametrize("mode", ["classic", "antialiased"])
COMPOSITORS = pytest.mark.parametrize("compositor", ["cpu", "gpu"])
BACKGROUND = (0.2, 0.5, 0.9)
FIELDS = ("means", "log_scales", "quats", "logit_opacities", "sh")


def random_grads(rendering, seed=0):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=a.shape) for a in (rendering.rgb, rendering.alpha, rendering.depth) if a is not None]


def images(rendering):
    return [a for a in (rendering.rgb, rendering.alpha, rendering.depth) if a is not None]


def turned(gaussians, camera, rotation_quat, shift, scale=1.0):
    """The scene and the camera in a world that is scaled, rotated and shifted; the image does not know."""
    rotation = rotations(np.array(rotation_quat, dtype=np.float64))
    w, xyz = rotation_quat[0], np.array(rotation_quat[1:])
    v, u = gaussians.quats[:, :1], gaussians.quats[:, 1:]
    quats = np.concatenate([w * v - u @ xyz[:, None], w * u + v * xyz + np.cross(xyz, u)], axis=1)
    moved = replace(
        gaussians,
        means=scale * gaussians.means @ rotation.T + shift,
        quats=quats,
        log_scales=gaussians.log_scales + np.log(scale),
    )
    viewmat = np.eye(4)
    viewmat[:3, :3] = camera.viewmat[:3, :3] @ rotation.T
    viewmat[:3, 3] = scale * camera.viewmat[:3, 3] - viewmat[:3, :3] @ shift
    return moved, replace(camera, viewmat=viewmat)


@MODES
@COMPOSITORS
def test_double_matches_twin(device64, mode, compositor):
    gaussians, camera = synthetic_scene(200, 1, width=53, height=38)
    twin = render(gaussians, camera, RenderConfig(mode), background=BACKGROUND, depth=True, device="reference")
    actual = render(
        gaussians, camera, RenderConfig(mode, compositor=compositor), device64, background=BACKGROUND, depth=True
    )
    for name in ("rgb", "alpha", "depth"):
        assert_matches(name, getattr(actual, name), getattr(twin, name), DOUBLE)
    v_images = random_grads(twin)
    expected, v = (r.backward(*v_images, viewmat_grad=True) for r in (twin, actual))
    for name, array in expected.gaussians.arrays().items():
        assert_matches(f"v_{name}", v.gaussians.arrays()[name], array, DOUBLE)
    assert_matches("v_means2d", v.means2d, expected.means2d, DOUBLE)
    assert_matches("v_viewmat", v.viewmat, expected.viewmat, DOUBLE)


@MODES
def test_float_matches_twin(device, mode):
    gaussians, camera = synthetic_scene(400, 2, width=97, height=71)
    gaussians = gaussians.astype(np.float32)
    config = RenderConfig(mode)
    twin = render(gaussians, camera, config, background=BACKGROUND, depth=True, device="reference")
    actual = render(gaussians, camera, config, device, background=BACKGROUND, depth=True)
    splats = reference.project_fwd(gaussians, camera, 3, antialiased=mode == "antialiased")
    band = ambiguous_pixels(splats, camera.width, camera.height, margin=1e-3)
    assert 0 < band.mean() < 0.3
    for name in ("rgb", "alpha"):
        assert_matches(name, getattr(actual, name), getattr(twin, name), FLOAT, where=~band)
    assert_matches("depth", actual.depth, twin.depth, FLOAT, where=~band & (twin.alpha > 0.01))
    v_images = random_grads(twin)
    for v_image in v_images:
        v_image[band | (twin.alpha < 0.01)] = 0
    expected, v = (r.backward(*v_images, viewmat_grad=True) for r in (twin, actual))
    for name, array in expected.gaussians.arrays().items():
        assert_matches(f"v_{name}", v.gaussians.arrays()[name], array, FLOAT)
    assert_matches("v_means2d", v.means2d, expected.means2d, FLOAT)
    assert_matches("v_viewmat", v.viewmat, expected.viewmat, FLOAT)


def check_gradients(device, gaussians, camera, config, **options):
    """Central differences of a random linear function of rgb, alpha and depth, by every parameter and the viewmat."""
    options = {"background": BACKGROUND, "depth": True} | options
    base = render(gaussians, camera, config, device, **options)
    v_images = random_grads(base)
    if options["depth"]:
        v_images[2][base.alpha < 0.05] = 0  # where depth is a quotient of small numbers

    def scalar(viewmat, **arrays):
        moved = render(Gaussians(**arrays), replace(camera, viewmat=viewmat), config, device, **options)
        return sum(float(((m - b) * v).sum()) for m, b, v in zip(images(moved), images(base), v_images, strict=True))

    v = base.backward(*v_images, viewmat_grad=True)
    inputs = {**gaussians.arrays(), "viewmat": camera.viewmat}
    gradcheck(scalar, inputs, {**v.gaussians.arrays(), "viewmat": v.viewmat})
    return v


@MODES
@COMPOSITORS
def test_central_differences(device64, mode, compositor):
    gaussians, camera = synthetic_scene(25, 3, margin=1e-3)
    assert threshold_distances(gaussians, camera, antialiased=mode == "antialiased").min() >= 1e-3
    check_gradients(device64, gaussians, camera, RenderConfig(mode, compositor=compositor))


@MODES
def test_central_differences_of_the_twin(mode):
    gaussians, camera = synthetic_scene(15, 4, margin=1e-3)
    check_gradients("reference", gaussians, camera, RenderConfig(mode))


@pytest.mark.parametrize("sh_degree", [0, 1, 2])
def test_central_differences_of_lower_degrees(device64, sh_degree):
    gaussians, camera = synthetic_scene(12, 5, margin=1e-3)
    v = check_gradients(device64, gaussians, camera, RenderConfig(), sh_degree=sh_degree, depth=False)
    assert (v.gaussians.sh[:, (sh_degree + 1) ** 2 :] == 0).all()


@MODES
def test_central_differences_in_the_clamped_zone(device64, mode):
    """Large Gaussians centred far outside the image, whose Jacobian is that of the border of the enlarged one."""
    antialiased = mode == "antialiased"
    for seed in range(200):
        gaussians, camera = synthetic_scene(6, seed, width=19, height=13)
        side = np.sign(np.random.default_rng(seed).normal(size=(6, 2)))
        z = np.random.default_rng(seed).uniform(3, 5, 6)
        points = np.stack([*(side * [0.8, 0.7] * [1, 13 / 19] * z[:, None]).T, z], axis=1)
        gaussians.means[:] = (points - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
        gaussians.log_scales[:] += 2.5
        if threshold_distances(gaussians, camera, antialiased=antialiased).min() >= 1e-3:
            break
    slopes = np.abs(points[:, :2] / points[:, 2:])
    assert (slopes > 1.15 * 0.65 * np.array([camera.width, camera.height]) / camera.fx).all()
    v = check_gradients(device64, gaussians, camera, RenderConfig(mode))
    assert (np.abs(v.gaussians.means).max(axis=1) > 0).all()


@COMPOSITORS
def test_nothing_depends_on_uninitialised_memory(configured_device, compositor, monkeypatch):
    """Buffers that start as NaN give the same bits: tiles that stop early, empty tiles, invisible Gaussians."""
    gaussians, camera = synthetic_scene(600, 11, width=53, height=38)
    gaussians.means[:, 0] = 0.5 * gaussians.means[:, 0] - 0.5
    gaussians.logit_opacities[:] += 3
    gaussians.means[::7] = 2 * camera.position
    config = RenderConfig("antialiased", compositor=compositor)
    v_images = [np.random.default_rng(0).normal(size=s) for s in ((38, 53, 3), (38, 53))]

    def everything():
        rendering = render(gaussians, camera, config, configured_device, depth=True)
        v = rendering.backward(*v_images, viewmat_grad=True)
        photo = configured_device.upload("photo", np.full((38, 53, 3), 99), np.uint8)
        image = configured_device.upload("image", rendering.rgb)
        loss, v_image = ops.l1_ssim(configured_device, image, photo, 0.2)
        return [*images(rendering), *v.gaussians.arrays().values(), v.means2d, v.viewmat, float(loss), v_image.get()]

    expected = everything()
    assert (expected[1] > 0.999).any() and (expected[1] == 0).any()
    empty = Device.empty

    def filled(self, what, shape, dtype=None):
        array = empty(self, what, shape, dtype)
        array.fill(np.nan if array.dtype.kind == "f" else np.iinfo(array.dtype).max)
        return array

    monkeypatch.setattr(Device, "empty", filled)
    for a, b in zip(everything(), expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_depth_of_one_opaque_gaussian(any_device):
    gaussians, camera = synthetic_scene(1)
    camera = replace(camera, viewmat=np.eye(4))
    gaussians.means[:] = (0, 0, 3.5)
    gaussians.logit_opacities[:] = 3
    rendering = render(gaussians, camera, RenderConfig(), any_device, depth=True)
    # In float32 alpha is 1 - T with an error of 1e-7, up to 1e-5 of a faint pixel's.
    np.testing.assert_allclose(rendering.depth[rendering.alpha > 0], 3.5, rtol=3e-5)
    assert (rendering.depth[rendering.alpha == 0] == 0).all() and (rendering.alpha == 0).any()


POISON = {
    "means": (np.nan, np.inf, -np.inf),
    "log_scales": (np.nan, np.inf),
    "quats": (np.nan, np.inf, 0.0, 1e-40),
    "logit_opacities": (np.nan, -np.inf),
    "sh": (np.nan, np.inf),
}


@MODES
@COMPOSITORS
def test_invalid_gaussians_leave_no_trace(any_device, mode, compositor):
    """The image is the same bits, and so are the gradients of the others but for the last: a compiler may round a sum
    otherwise in the rest of a vector, as Intel's does. The invalid have gradients of 0."""
    gaussians, camera = synthetic_scene(60, 8)
    parts = [gaussians]
    for name, values in POISON.items():
        for value in values:
            row = gaussians.take([0])
            row.means[:] = 0
            getattr(row, name)[:] = value
            parts.append(row)
    behind = gaussians.take([1])
    behind.means[:] = 2 * camera.position
    parts.append(behind)
    n_bad = sum(map(len, parts[1:]))
    # Put in front, so that indices shift.
    mixed = Gaussians.concatenate([*parts[1:], gaussians]).astype(any_device.real)
    clean = gaussians.astype(any_device.real)
    config = RenderConfig(mode, compositor=compositor)
    expected, actual = (render(g, camera, config, any_device, depth=True) for g in (clean, mixed))
    for a, b in zip(images(actual), images(expected), strict=True):
        assert np.isfinite(a).all()
        np.testing.assert_array_equal(a, b)
    v_images = random_grads(expected)
    v, w = (r.backward(*v_images) for r in (expected, actual))
    for name, array in w.gaussians.arrays().items():
        assert (array[:n_bad] == 0).all(), name
        last_bit = np.finfo(any_device.real).eps * np.abs(v.gaussians.arrays()[name]).max()
        np.testing.assert_allclose(array[n_bad:], v.gaussians.arrays()[name], rtol=0, atol=last_bit, err_msg=name)
    assert (w.means2d[:n_bad] == 0).all()


@MODES
def test_extreme_gaussians_stay_finite(any_device, mode):
    gaussians, camera = synthetic_scene(60, 9)
    rows = gaussians.take(np.arange(12))
    rows.means[:] = 0
    rows.log_scales[0] = 10
    rows.log_scales[1] = -60
    rows.log_scales[2] = [3, -30, -30]
    rows.log_scales[3] = [2, 2, -np.inf]
    rows.quats[4] *= 1e12
    rows.quats[5] *= 1e-3
    rows.logit_opacities[6] = np.inf
    rows.logit_opacities[7] = 90
    rows.sh[8] = 1e8
    rows.sh[9] = -1e8
    eye, forward = camera.position, camera.viewmat[2, :3]
    rows.means[10] = eye + NEAR * (1 + 1e-4) * forward
    rows.means[11] = eye + 1e5 * forward
    mixed = Gaussians.concatenate([gaussians, rows]).astype(any_device.real)
    rendering = render(mixed, camera, RenderConfig(mode), any_device, depth=True)
    v = rendering.backward(*random_grads(rendering), viewmat_grad=True)
    for name, array in [*v.gaussians.arrays().items(), ("viewmat", v.viewmat), ("means2d", v.means2d)]:
        assert np.isfinite(array).all(), name
    assert all(np.isfinite(a).all() for a in images(rendering))


@COMPOSITORS
@pytest.mark.parametrize(("width", "height"), [(1, 1), (4099, 3)])
def test_image_sizes(device64, compositor, width, height):
    gaussians, _ = synthetic_scene(40, 10)
    focal = 1.2 * max(width, height)
    camera = Camera.look_at((1.5, -1.0, 3.57), (0, 0, 0), (0, 1, 0), focal, width, height)
    gaussians.means[:, 1] *= 0.01
    config = RenderConfig(compositor=compositor)
    expected, actual = (render(gaussians, camera, config, d, background=BACKGROUND) for d in ("reference", device64))
    assert expected.alpha.max() > 0.1
    assert_matches("rgb", actual.rgb, expected.rgb, DOUBLE)
    v_images = random_grads(expected)
    v, w = (r.backward(*v_images, viewmat_grad=True) for r in (expected, actual))
    for name, array in v.gaussians.arrays().items():
        assert_matches(f"v_{name}", w.gaussians.arrays()[name], array, DOUBLE)


@pytest.mark.parametrize("twin", [True, False], ids=["twin", "device"])
def test_no_gaussians(device, twin):
    gaussians, camera = synthetic_scene(0)
    rendering = render(
        gaussians, camera, RenderConfig(), "reference" if twin else device, background=BACKGROUND, depth=True
    )
    np.testing.assert_allclose(rendering.rgb, np.broadcast_to(BACKGROUND, rendering.rgb.shape), rtol=1e-6)
    assert (rendering.alpha == 0).all() and (rendering.depth == 0).all()
    rendering.rgb[0, 0] = 0.5  # an array of its own, as of any Gaussians
    assert (rendering.rgb == 0.5).all(axis=2).sum() == 1
    v = rendering.backward(*random_grads(rendering), viewmat_grad=True)
    assert len(v.gaussians) == 0 and v.gaussians.sh.shape == (0, 16, 3) and v.means2d.shape == (0, 2)
    assert (v.viewmat == 0).all()


@pytest.mark.parametrize("n", [1, 7])
def test_all_off_screen(any_device, n):
    gaussians, camera = synthetic_scene(n)
    gaussians.means[:] = 2 * camera.position
    rendering = render(gaussians, camera, RenderConfig(), any_device, background=BACKGROUND)
    np.testing.assert_array_equal(
        rendering.rgb, np.broadcast_to(np.array(BACKGROUND, any_device.real), rendering.rgb.shape)
    )
    v = rendering.backward(*random_grads(rendering), viewmat_grad=True)
    assert all((a == 0).all() for a in v.gaussians.arrays().values()) and (v.viewmat == 0).all()


def test_one_gaussian(device64):
    gaussians, camera = synthetic_scene(1, 3, margin=1e-3)
    check_gradients(device64, gaussians, camera, RenderConfig())


@pytest.mark.parametrize("twin", [False, True])
def test_gradients_do_not_follow_changes_in_place(device, twin):
    """Of the image, alpha and depth that were returned, and of the Gaussians that were rendered."""
    gaussians, camera = synthetic_scene(20, seed=3)
    where = "reference" if twin else device
    changed, kept = (render(gaussians, camera, device=where, depth=True) for _ in range(2))
    v_images = random_grads(kept)
    expected, surface = kept.backward(*v_images), kept.surface()
    for array in (changed.rgb, changed.alpha, changed.depth, *gaussians.arrays().values()):
        array *= 0.5
    found = changed.backward(*v_images)
    for one, other in zip(found.gaussians.arrays().values(), expected.gaussians.arrays().values(), strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(changed.surface(), surface, strict=True):
        np.testing.assert_array_equal(one, other)


def test_gradients_left_out_are_zero(device):
    gaussians, camera = synthetic_scene(30)
    rendering = render(gaussians, camera, RenderConfig(), device, depth=True)
    v_rgb, v_alpha, v_depth = random_grads(rendering)
    parts = [rendering.backward(v_rgb), rendering.backward(None, v_alpha), rendering.backward(None, None, v_depth)]
    whole = rendering.backward(v_rgb, v_alpha, v_depth)
    assert whole.viewmat is None
    total = sum(p.gaussians.means for p in parts)
    np.testing.assert_allclose(total, whole.gaussians.means, atol=1e-4 * np.abs(total).max())
    assert all((a == 0).all() for a in rendering.backward().gaussians.arrays().values())
