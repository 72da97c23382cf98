"""Camera models of the stage project: against the twin, central differences, and what they are limits of."""

from dataclasses import replace

import numpy as np
import pytest
from test_project import (
    assert_cameras_match,
    backward,
    check_gradients,
    forward,
    from_view,
    random_grads,
    wide_scene,
)
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.bench.stability.small import CONFIG, known_gaussians, small_scene
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.errors import InputError
from clsplat.evaluate import mean_metrics
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.stages import Splats
from clsplat.testing import assert_matches, synthetic_scene, threshold_distances
from clsplat.training.initialize import initialize
from clsplat.training.loop import train

WIDE = (0.05, -0.01, 0.003, -0.0004)
MODELS = pytest.mark.parametrize("model", ["orthographic", "fisheye"])
EACH = pytest.mark.parametrize("model", ["pinhole", "orthographic", "fisheye"])


def as_model(camera, model):
    """A camera of the same place and size whose image shows as much at a depth of 4, a fisheye all it can."""
    if model == "orthographic":
        return replace(camera, fx=camera.fx / 4, fy=1.1 * camera.fy / 4, model=model)
    if model == "fisheye":  # 110 degrees to the sides
        return replace(camera, fx=camera.width / 4, fy=camera.width / 3.8, model=model, distortion=WIDE)
    return camera


def scene_around(model, n=1000, seed=5):
    """Gaussians in front of an orthographic camera and behind it, and all around a fisheye; float32 values."""
    gaussians, camera = wide_scene(n, seed)
    camera, rng = as_model(camera, model), np.random.default_rng(seed)
    points = rng.normal(size=(n, 3)) * rng.uniform(0.1, 3, (n, 1))
    if model == "orthographic":
        points[:, :2] = rng.uniform(-0.6, 0.6, (n, 2)) * [camera.width / camera.fx, camera.height / camera.fy]
    points[0] = 0, 0, 2  # on the axis
    gaussians.means[:] = from_view(camera, points)
    gaussians.log_scales -= 1
    return gaussians, camera


@MODELS
@pytest.mark.parametrize("degree", [0, 3])
def test_kernels_match_twin(any_device, model, degree):
    gaussians, camera = scene_around(model)
    table = FLOAT if any_device.real == np.float32 else DOUBLE
    actual = forward(any_device, gaussians, camera, degree, channels=4)
    expected = reference.project_fwd(gaussians, camera, degree, channels=4)
    same = (actual.extents[:, 0] > 0) == (expected.extents[:, 0] > 0)
    assert 0.2 < (expected.extents[:, 0] > 0).mean() < 0.9, "the scene lacks a case"
    assert (~same).sum() <= (1 if table is FLOAT else 0)  # as in test_float_matches_twin
    for name in Splats._fields:
        assert_matches(name, getattr(actual, name), getattr(expected, name), table, where=same)

    v_splats = random_grads(expected)
    v, v_camera = backward(any_device, gaussians, camera, expected, v_splats, degree, camera_grad=True)
    v_expected, v_camera_expected = reference.project_bwd(
        gaussians, camera, degree, expected, v_splats, camera_grad=True
    )
    for name, array in v_expected.arrays().items():
        assert_matches(f"v_{name}", v.arrays()[name], array, table)
    assert_cameras_match(v_camera, v_camera_expected, table)

    uploaded = Splats(*(any_device.upload("splats", a) for a in expected))
    found = ops.project_disparities(any_device, Renderer(any_device).place(gaussians), camera, uploaded).get()
    disparities = reference.project_disparities(gaussians, camera, expected)
    for column in range(3):
        assert_matches("disparities", found[:, column], disparities[:, column], table)
    pixels = ops.pixel_sizes(any_device, Renderer(any_device).place(gaussians), [camera]).get()
    np.testing.assert_allclose(pixels, reference.pixel_sizes(gaussians, [camera]), rtol=1e-5)


@MODELS
@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
def test_central_differences(device64, model, antialiased):
    gaussians, camera = scene_around(model, 120, seed=1)
    gaussians = gaussians.astype(np.float64)
    clear = threshold_distances(gaussians, camera, antialiased=antialiased) > 1e-4
    splats = reference.project_fwd(gaussians, camera, 3, antialiased=antialiased)
    gaussians = gaussians.take(clear & (splats.extents[:, 0] > 0))
    behind = gaussians.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3] < 0
    assert len(gaussians) > 15 and behind.any() == (model == "fisheye"), "the scene lacks a case"
    check_gradients(device64, gaussians, camera, antialiased)


@pytest.mark.parametrize("slope", [0, 1e-7, 0.0099, 0.0101, 0.05])
def test_central_differences_near_a_fisheyes_axis(device64, slope):
    """On both sides of where the power series ends, and on the axis."""
    gaussians, camera = synthetic_scene(2, seed=2)
    camera = as_model(camera, "fisheye")
    gaussians.means[:] = from_view(camera, [(0.6 * slope * 2, 0.8 * slope * 2, 2), (-3 * slope, 0, 3)])
    gaussians.logit_opacities[:] = 1
    check_gradients(device64, gaussians, camera, False)


def test_a_fisheye_is_opencvs():
    """theta_d by hand, at 30 and at 120 degrees from the axis."""
    camera = Camera(np.eye(4), 100, 50, 32, 24, 640, 480, "fisheye", WIDE)
    theta = np.radians([30, 120])
    points = np.stack([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)], axis=1) * 3
    gaussians, _ = synthetic_scene(2)
    gaussians.means[:] = points
    gaussians.log_scales[:] = -3
    splats = reference.project_fwd(gaussians, camera, 0)
    radius = sum(k * theta ** (2 * i + 1) for i, k in enumerate((1, *WIDE)))
    np.testing.assert_allclose(splats.means2d, np.stack([60 * radius + 32, 40 * radius + 24], axis=1))
    np.testing.assert_allclose(splats.depths, 3)
    np.testing.assert_allclose(3 * camera.rays(*splats.means2d.T), points, atol=1e-12)


@EACH
def test_small_gaussians_are_where_their_rays_go(model):
    """The local affine approximation: the image of a small Gaussian is the density along the pixels' rays, and the
    error falls with its size."""
    _, camera = synthetic_scene(1, width=64, height=48)
    camera = as_model(replace(camera, viewmat=np.eye(4)), model)
    rng = np.random.default_rng(3)
    axes, sizes = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.array([1.0, 0.6, 0.3])
    point = np.array([0.5, -0.3, 2.0] if model != "fisheye" else [1.5, 0.4, -0.3])
    errors = []
    for scale in (0.1, 0.05, 0.025):
        camera = camera.resized(64 * round(0.1 / scale), 48 * round(0.1 / scale))  # as many pixels
        whiten = axes / (scale * sizes)
        f = reference.lens.lens(camera, point[None])
        cov = f["jacobian"][0] @ np.linalg.inv(whiten @ whiten.T) @ f["jacobian"][0].T
        offsets = np.linalg.cholesky(cov) @ rng.normal(size=(2, 500))
        u, v = f["means2d"][0][:, None] + offsets
        # The least squared distance of a ray from the centre, in standard deviations.
        rays = camera.rays(u, v) @ whiten
        origins = np.zeros((500, 3))
        if model == "orthographic":
            origins[:, 0], origins[:, 1] = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        to_centre = (point - origins) @ whiten
        along = (to_centre * rays).sum(axis=1) / (rays**2).sum(axis=1)
        exact = ((to_centre - along[:, None] * rays) ** 2).sum(axis=1)
        affine = np.einsum("ik,ij,jk->k", offsets, np.linalg.inv(cov), offsets)
        errors.append(np.abs(np.exp(-exact / 2) - np.exp(-affine / 2)).max())
    if model == "orthographic":
        assert max(errors) < 1e-9  # affine itself
    else:
        assert 0.03 < errors[0] < 0.3 and (np.divide(errors[1:], errors[:-1]) < 0.65).all()


def test_an_orthographic_camera_is_a_pinhole_far_away():
    gaussians, camera = synthetic_scene(30, seed=1)
    shift, far = np.eye(4), 1e5
    shift[2, 3] = far
    at = replace(camera, fx=9, fy=8, cx=camera.cx + 1, model="orthographic")
    pinhole = replace(at, model="pinhole", viewmat=shift @ camera.viewmat, fx=9 * (far + 4), fy=8 * (far + 4))
    near, distant = (reference.project_fwd(gaussians, c, 3) for c in (at, pinhole))
    assert (near.extents[:, 0] > 0).sum() > 20
    for name in ("means2d", "conics", "opacities", "colors"):
        np.testing.assert_allclose(getattr(near, name), getattr(distant, name), rtol=2e-3, atol=2e-3)


def test_a_fisheye_is_a_pinhole_near_its_axis():
    gaussians, camera = synthetic_scene(30, seed=1)
    narrow = replace(camera, fx=2000, fy=2000)
    points = np.random.default_rng(0).uniform(-1, 1, (30, 3)) * [0.02, 0.02, 1] + [0, 0, 3]
    gaussians.means[:] = from_view(camera, points)
    gaussians.log_scales -= 4
    fisheye = replace(narrow, model="fisheye")
    first, second = (reference.project_fwd(gaussians, c, 3) for c in (narrow, fisheye))
    both = (first.extents[:, 0] > 0) & (second.extents[:, 0] > 0)
    assert both.sum() > 20
    # f theta^3/3 at 20 px from the axis is 1e-3 px; depths are distances, 3e-5 more.
    for name, rtol in (("means2d", 1e-4), ("conics", 1e-3), ("depths", 1e-3), ("colors", 0)):
        expected = getattr(first, name)[both]
        np.testing.assert_allclose(getattr(second, name)[both], expected, rtol=rtol, atol=rtol * expected.max())


@pytest.mark.parametrize(
    ("degrees", "seen"), [(0, True), (89, True), (91, True), (119, True), (150, False), (180, False)]
)
def test_a_fisheye_sees_as_far_as_its_image(any_device, degrees, seen):
    focal = 32 / np.radians(120)  # at the edges
    camera = Camera(np.eye(4), focal, focal, 32, 32, 64, 64, "fisheye")
    gaussians, _ = synthetic_scene(1)
    gaussians.means[0] = 2 * np.array([np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))])
    gaussians.log_scales[0] = -4
    splats = forward(any_device, gaussians, camera)
    assert (splats.extents[0, 0] > 0) == seen
    v, v_camera = backward(any_device, gaussians, camera, splats, random_grads(splats), camera_grad=True)
    for name, array in [*splats._asdict().items(), *v.arrays().items(), *v_camera._asdict().items()]:
        assert np.isfinite(array).all(), name


def test_where_a_fisheyes_radius_turns_its_image_ends():
    camera = Camera(np.eye(4), 20, 20, 32, 32, 64, 64, "fisheye", (-0.1, 0, 0, 0))
    # d/dtheta theta - 0.1 theta^3 = 0
    assert camera.angle_max == pytest.approx(np.sqrt(1 / 0.3))
    rays = camera.rays([32.0, 63.5], [32.5, 0.5])
    assert np.isfinite(rays[0]).all() and np.isnan(rays[1]).all()


@EACH
def test_gradients_of_intrinsics_by_rendering(model):
    """Rendering.backward returns them on request; central differences of an image."""
    gaussians, camera = synthetic_scene(8, seed=4, margin=0)
    camera = as_model(camera, model)
    weights = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3))
    v = render(gaussians, camera, device="reference").backward(weights, intrinsics_grad=True)
    assert v.viewmat is None
    for k, name in enumerate(("fx", "fy", "cx", "cy")):
        value, step = getattr(camera, name), 1e-6
        ends = [
            render(gaussians, replace(camera, **{name: value + s}), device="reference").rgb for s in (-step, step)
        ]
        assert v.intrinsics[k] == pytest.approx(((ends[1] - ends[0]) * weights).sum() / (2 * step), rel=1e-5)
    assert render(gaussians, camera, device="reference").backward(weights).intrinsics is None


@EACH
def test_one_image_for_each_tiling(device, model):
    gaussians, camera = scene_around(model, 300)
    images = [render(gaussians, camera, RenderConfig(tile_size=t), device).rgb for t in (8, 16, 32)]
    twin = render(gaussians, camera, device="reference").rgb
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], atol=1e-4)  # float32 sums in blocks of other places
    assert (np.abs(images[0] - twin) > 2e-4).mean() < 1e-3  # thresholds may flip
    assert twin.std() > 0.05


def test_invalid_cameras_are_refused(device):
    gaussians, camera = synthetic_scene(2)
    with pytest.raises(InputError, match="expected a model among pinhole, orthographic"):
        replace(camera, model="mirror")
    with pytest.raises(InputError, match="0 for models other than fisheye"):
        replace(camera, distortion=WIDE)
    for where in (device, None):
        function = ops.project_fwd if where else reference.project_fwd
        arguments = (device, Renderer(device).place(gaussians)) if where else (gaussians,)
        with pytest.raises(InputError, match="found an equirectangular one"):
            function(*arguments, Camera.panorama(np.eye(4), 32), 0)


@MODELS
def test_scenes_train_on_every_model(device, tmp_path, model):
    """From points 0.05 off, on photos of that model alone. Measured: orthographic ones from 17.9 to
    31.2 dB, fisheyes from 26.9 to 40.1."""
    scene = small_scene(device)

    def through(views):
        cameras = [as_model(view.camera, model) for view in views]
        photos = [to_uint8(render(known_gaussians(), camera, device=device).rgb) for camera in cameras]
        return [replace(v, camera=c, image=p) for v, c, p in zip(views, cameras, photos, strict=True)]

    scene = replace(scene, train=through(scene.train), test=through(scene.test))
    start = mean_metrics(initialize(scene, CONFIG.init, 0), scene.test, Renderer(device))["psnr"]
    found = mean_metrics(train(scene, CONFIG, tmp_path, device), scene.test, Renderer(device))["psnr"]
    assert found > max(30, start + 5), (start, found)
