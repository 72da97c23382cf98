"""Projection along rays: against the density itself, against the twin, against central differences."""

from dataclasses import replace

import numpy as np
import pytest
from test_lens import WIDE, scene_around
from test_project import assert_cameras_match, backward, forward, from_view
from tolerances import ALONG_RAYS, DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.bench.stability.projection import harm, poisons, shell
from clsplat.camera import Camera, pixel_rays
from clsplat.config import RenderConfig
from clsplat.constants import ALPHA_MIN, BLUR
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, sigmoid
from clsplat.pruning.prices import price
from clsplat.reference.gaussian_rays import chart_offsets, ray_exponents
from clsplat.reference.lens import lens
from clsplat.reference.project import rotations
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.stages import Bins, Image, RayGrads, RaySplats
from clsplat.testing import assert_matches, gradcheck, synthetic_scene

RAYS = RenderConfig(projection="ray")
MODELS = ("pinhole", "fisheye", "equirectangular")
EACH = pytest.mark.parametrize("model", MODELS)
MODES = pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])


def as_model(camera, model):
    """A camera of the same place and about the same size with another lens."""
    if model == "fisheye":  # 110 degrees to the sides
        return replace(camera, fx=camera.width / 4, fy=camera.width / 3.8, model=model, distortion=WIDE)
    if model == "equirectangular":
        return replace(Camera.panorama(camera.viewmat, 2 * (camera.width // 2)), near=camera.near)
    return camera


def wide_scene(model, n=400):
    """Gaussians all around a camera: across its plane, over poles and the seam of a panorama; float32 values."""
    gaussians, camera = scene_around("fisheye", n)
    pinhole = Camera(camera.viewmat, 40, 44, camera.cx, camera.cy, camera.width, camera.height)
    points = np.array([[0.2, 3.0, 0.1], [0.1, -3, 0.2], [0.01, 0.3, -3], [2.5, 0.1, 0.05], [0.3, 0.2, 0.6]])
    gaussians.means[: len(points)] = from_view(camera, points)
    gaussians.log_scales[: len(points)] = np.log([[0.5, 0.1, 0.3]])
    gaussians.logit_opacities[: len(points)] = 2
    return gaussians.astype(np.float32), as_model(pinhole, model)


def view_scene(model, n=12):
    """A few Gaussians in the image, at a distance from every threshold."""
    gaussians, camera = synthetic_scene(n, 1, width=40, height=30, margin=1e-3)
    return gaussians, as_model(camera, model)


def densities(gaussians, camera):
    """Squared distances of all pixels' rays from the centres, (N, H, W), in standard deviations, and `ahead`.

    By the definition |w x u|^2/|u|^2 alone: with the inverse of the square root of the covariance, and no chart.
    """
    g = gaussians.astype(np.float64)
    p = g.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    axes = camera.viewmat[:3, :3] @ rotations(g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True))
    depths = p[:, 2] if camera.model == "pinhole" else np.linalg.norm(p, axis=1)
    wide = np.sqrt(g.scales**2 + BLUR * (depths**2 / (camera.fx * camera.fy))[:, None])
    whiten = np.swapaxes(axes, 1, 2) / wide[:, :, None]
    w = np.einsum("nij,nj->ni", whiten, p)[:, None, None]
    u = np.einsum("nij,hwj->nhwi", whiten, pixel_rays(camera))
    with np.errstate(invalid="ignore"):
        squares = (np.cross(w, u) ** 2).sum(axis=3) / (u**2).sum(axis=3)
    return squares, (w * u).sum(axis=3) > 0


def up(device, container):
    """A container of arrays on the device."""
    return type(container)(*(device.upload("x", a) for a in container))


@EACH
def test_the_exponent_is_the_density_along_the_ray(model):
    gaussians, camera = wide_scene(model)
    splats = reference.project_fwd(gaussians, camera, 0, rays=True)
    squares, ahead = densities(gaussians, camera)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    shown = np.flatnonzero(splats.extents[:, 0] > 0)
    assert len(shown) > 50
    for i in shown:
        sigma = ray_exponents(splats.rays[i], chart_offsets(splats.rays[i], splats.directions, columns, rows))[0]
        inside = ahead[i] & (sigma < 50)
        # sigma is a quotient of numbers of up to 1e6, the squared distance of the camera in standard deviations.
        np.testing.assert_allclose(sigma[inside], 0.5 * squares[i][inside], rtol=1e-7, atol=1e-7)
        assert not (np.isfinite(sigma) & ~ahead[i] & (squares[i] > 0)).any()


@EACH
def test_nothing_is_visible_outside_the_outline(model):
    gaussians, camera = wide_scene(model)
    splats = reference.project_fwd(gaussians, camera, 0, rays=True)
    squares, ahead = densities(gaussians, camera)
    alphas = np.where(ahead, sigmoid(gaussians.logit_opacities)[:, None, None] * np.exp(-0.5 * squares), 0)
    p = gaussians.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    alphas[~lens(camera, p)["seen"]] = 0  # too near, or beyond what the lens shows
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    for i, alpha in enumerate(np.where(np.isfinite(alphas), alphas, 0)):
        dx, dy = u - splats.means2d[i, 0], v - splats.means2d[i, 1]
        within = (np.abs(dx) <= splats.extents[i, 0]) & (np.abs(dy) <= splats.extents[i, 1])
        a, b, c = splats.conics[i]
        r2 = 2 * np.log(sigmoid(gaussians.logit_opacities[i]) / ALPHA_MIN) + 0.01
        within &= a * dx**2 + 2 * b * dx * dy + c * dy**2 <= r2
        assert not (alpha[~within] > 1.01 * ALPHA_MIN).any(), i
    boxes = (splats.conics[:, 0] == 0) & (splats.extents[:, 0] > 0)
    assert boxes.any() and (model != "pinhole" or not boxes.all()), "the scene lacks a case"


@MODES
@EACH
def test_projection_matches_twin(device64, model, antialiased):
    gaussians, camera = wide_scene(model)
    channels = 4 if antialiased else 3
    options = {"antialiased": antialiased}
    more = {"rays": True, "channels": channels, "gain": 1.25 if antialiased else 1.0}
    expected = reference.project_fwd(gaussians, camera, 3, **more, **options)
    actual = forward(device64, gaussians, camera, 3, **more, **options)
    np.testing.assert_array_equal(actual.extents[:, 0] > 0, expected.extents[:, 0] > 0)
    for name in RaySplats._fields:
        assert_matches(name, getattr(actual, name), getattr(expected, name), DOUBLE)
    rng = np.random.default_rng(0)
    shapes = {name: getattr(expected, "conics" if name == "slopes" else name).shape for name in RayGrads._fields}
    v = RayGrads(**{name: rng.normal(size=shape) for name, shape in shapes.items()})
    options["camera_grad"] = True
    v_expected, v_camera_expected = reference.project_bwd(gaussians, camera, 3, expected, v, **options)
    v_actual, v_camera = backward(device64, gaussians, camera, expected, v, 3, **options)
    for name, array in v_expected.arrays().items():
        assert_matches(f"v_{name}", v_actual.arrays()[name], array, ALONG_RAYS)
    assert_cameras_match(v_camera, v_camera_expected, DOUBLE)


@pytest.mark.parametrize("compositor", ["cpu", "gpu"])
@EACH
def test_compositing_matches_twin(any_device, model, compositor):
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    gaussians, camera = view_scene(model, 60)
    splats = reference.project_fwd(gaussians, camera, 0, rays=True)
    splats = RaySplats(*(a.astype(any_device.real).astype(np.float64) for a in splats))
    bins = reference.bin_splats(splats, camera.width, camera.height, 16)
    expected = reference.composite_fwd(splats, bins, np.array([0.2, 0.5, 0.8]))
    v_image = Image(*(np.random.default_rng(0).normal(size=a.shape) for a in expected))
    v_image = Image(*(a.astype(any_device.real).astype(np.float64) for a in v_image))
    lists = Bins(*(any_device.upload("x", a, np.uint32) for a in bins[:4]), *bins[4:])
    image = ops.composite_fwd(any_device, up(any_device, splats), lists, [0.2, 0.5, 0.8], compositor=compositor)
    assert_matches("image", image.rgb.get(), expected.rgb, tolerances)
    rounded = Image(*(a.get().astype(np.float64) for a in image))
    v_expected = reference.composite_bwd(splats, bins, rounded, v_image)
    v = ops.composite_bwd(
        any_device, up(any_device, splats), lists, image, up(any_device, v_image), compositor=compositor
    )
    for name in RayGrads._fields:
        assert_matches(f"v_{name}", getattr(v, name).get(), getattr(v_expected, name), tolerances)


@pytest.mark.parametrize("model", ["fisheye", "equirectangular"])
def test_pixels_outside_the_image_do_not_matter(kernels, model):
    """Blocks that the border cuts off have pixels without directions, whatever the stack holds in their place."""
    gaussians, camera = wide_scene(model)
    camera = replace(camera, width=37, height=29)
    path, results = kernels / "composite_blocks.h", []
    source = path.read_text()
    assert source.count("Grid grid;") == 1
    for filling in ("(REALV)1", "(REALV)NAN"):
        fill = f"\n#if RAYS == 2\nfor (int i = 0; i < 3 * BLOCKS; ++i) (&grid.rays[0][0])[i] = {filling};\n#endif\n"
        path.write_text(source.replace("Grid grid;", "Grid grid;" + fill))
        rendering = render(gaussians, camera, replace(RAYS, tile_size=16, compositor="cpu"), Device())
        results.append(rendering.backward(np.ones_like(rendering.rgb)).gaussians)
    assert np.abs(results[0].means).max() > 0
    np.testing.assert_array_equal(results[1].means, results[0].means)


def scalar(image, camera, device, config, weights):
    """A function of the Gaussians and the camera whose gradient is that of `weights` by colours and depth."""

    def function(pose=None, intrinsics=None, **fields):
        changed = camera
        if pose is not None:  # a small motion, to first order
            a, b, c = pose[:3]
            turn = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
            viewmat = camera.viewmat.copy()
            viewmat[:3] += np.concatenate([turn @ camera.viewmat[:3, :3], pose[3:, None]], axis=1)
            changed = replace(camera, viewmat=viewmat)
        if intrinsics is not None:
            changed = replace(camera, **dict(zip(("fx", "fy", "cx", "cy"), intrinsics, strict=True)))
        rendering = render(Gaussians(**{**image.arrays(), **fields}), changed, config, device, depth=True)
        return float((rendering.rgb * weights[0]).sum() + (rendering.depth * weights[1]).sum())

    return function


@MODES
@EACH
def test_gradients_by_central_differences(device64, model, antialiased):
    gaussians, camera = view_scene(model)
    config = replace(RAYS, mode="antialiased" if antialiased else "classic")
    rendering = render(gaussians, camera, config, device64, depth=True)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=rendering.rgb.shape), rng.normal(size=rendering.alpha.shape)
    v = rendering.backward(weights[0], None, weights[1], viewmat_grad=True, intrinsics_grad=model == "pinhole")
    function = scalar(gaussians, camera, device64, config, weights)
    gradcheck(function, gaussians.arrays(), v.gaussians.arrays(), rtol=3e-6)
    turns = np.zeros((3, 3, 3))
    turns[[0, 1, 2], [2, 0, 1], [1, 2, 0]], turns[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1, -1
    by_turn = np.einsum("ij,kil,lj->k", v.viewmat[:3, :3], turns, camera.viewmat[:3, :3])
    # A motion changes the rotation to first order only, and the colours by spherical harmonics see a second order.
    gradcheck(function, {"pose": np.zeros(6)}, {"pose": np.append(by_turn, v.viewmat[:3, 3])}, rtol=1e-5)
    if model == "pinhole":
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        gradcheck(function, {"intrinsics": intrinsics}, {"intrinsics": v.intrinsics}, step=1e-5)


@EACH
def test_rendering_matches_twin_and_tiles_do_not_matter(any_device, model):
    gaussians, camera = view_scene(model, 60)
    gaussians = gaussians.astype(np.float32)
    expected = render(gaussians, camera, RAYS, "reference", depth=True)
    images = [render(gaussians, camera, replace(RAYS, tile_size=size), any_device).rgb for size in (8, 16, 32)]
    np.testing.assert_array_equal(*images)
    assert expected.alpha.max() > 0.5
    assert_matches("rgb", images[0], expected.rgb, DOUBLE if any_device.real == np.float64 else FLOAT)


def test_a_small_pinhole_is_the_affine_projection(device):
    gaussians, camera = synthetic_scene(60, 1, width=40, height=30)
    gaussians.log_scales[:] = np.log(0.05)
    narrow = replace(camera, fx=8 * camera.fx, fy=8 * camera.fy)
    affine, along = (render(gaussians, narrow, c, device).rgb for c in (RenderConfig(), RAYS))
    # Over the eight degrees of the image, the blur of a ray differs by a cosine.
    np.testing.assert_allclose(along, affine, atol=0.02)


def test_a_panorama_in_one_pass_agrees_with_its_faces(device):
    scene, camera = shell(400).astype(np.float32), Camera.panorama(np.eye(4), 256)
    whole, faces = (render(scene, camera, c, device, gradients=False).rgb for c in (RAYS, RenderConfig()))
    # The faces are affine, up to 55 degrees from their axes, and are interpolated.
    assert -10 * np.log10(((whole - faces) ** 2).mean()) > 25
    # The seam and the poles are in no way special.
    turned = camera.viewmat.copy()
    turned[:3, :3] = [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]
    half_turn = render(scene, replace(camera, viewmat=turned), RAYS, device, gradients=False).rgb
    np.testing.assert_allclose(np.roll(half_turn, 128, axis=1), whole, atol=1e-4)


@pytest.mark.parametrize(("field", "value"), poisons())
def test_a_poison_harms_no_other_gaussian(device, field, value):
    assert harm(device, field, value, RAYS) == ""


@EACH
def test_a_removal_changes_the_error_as_priced(device64, model):
    gaussians, camera = view_scene(model)
    target = np.random.default_rng(0).integers(0, 255, (camera.height, camera.width, 3)).astype(np.uint8)
    prices = price(gaussians, [View("a", camera, target)], Renderer(device64, RAYS)).errors

    def error(some):
        return ((render(some, camera, RAYS, device64).rgb - target / 255) ** 2).sum()

    k = int(np.argmax(np.abs(prices)))
    removed = error(gaussians.take(np.arange(len(gaussians)) != k)) - error(gaussians)
    pixels = camera.width * camera.height
    assert prices[k] == pytest.approx(removed, rel=1e-6) or prices[k] == pytest.approx(removed / pixels, rel=1e-6)


def test_an_orthographic_camera_stays_affine(device):
    gaussians, camera = synthetic_scene(20, 1)
    camera = replace(camera, model="orthographic", fx=camera.fx / 4, fy=camera.fy / 4)
    np.testing.assert_array_equal(*(render(gaussians, camera, c, device).rgb for c in (RenderConfig(), RAYS)))
    with pytest.raises(InputError, match="rays=True"):
        ops.project_fwd(device, Renderer(device).place(gaussians), camera, 0, rays=True)


def test_what_rays_do_not_support_is_a_sentence(device):
    with pytest.raises(InputError, match="sort"):
        Renderer(device, replace(RAYS, sort="pixel"))
    gaussians, camera = view_scene("fisheye")
    with pytest.raises(InputError, match="intrinsics"):
        render(gaussians, camera, RAYS, device).backward(np.zeros((30, 40, 3)), intrinsics_grad=True)


def test_the_second_image_has_the_same_bits():
    device = Device()
    gaussians, camera = view_scene("fisheye", 60)
    one, two = (render(gaussians, camera, RAYS, device) for _ in range(2))
    np.testing.assert_array_equal(one.rgb, two.rgb)
    v = np.ones_like(one.rgb)
    np.testing.assert_array_equal(one.backward(v).gaussians.means, two.backward(v).gaussians.means)
