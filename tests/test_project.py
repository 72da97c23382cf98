"""Stage project: against the twin, against central differences, on degenerate input."""

from dataclasses import replace

import numpy as np
import pytest
from device_opening import open_device
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.camera import Camera
from clsplat.config import OptimConfig
from clsplat.constants import ALPHA_MIN, COMPENSATION_MIN, FRUSTUM_MARGIN
from clsplat.gaussians import Gaussians, logit
from clsplat.reference.project import rotations as reference_rotations
from clsplat.renderer import Renderer, download
from clsplat.stages import SplatGrads, Splats
from clsplat.testing import assert_matches, gradcheck, synthetic_scene, threshold_distances
from clsplat.training.optimizer import adam_settings

INTRINSICS = ("fx", "fy", "cx", "cy")
GRADIENTS = ("means2d", "conics", "opacities", "colors")
MODES = pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])


def host(arrays):
    """The same container with NumPy arrays."""
    if isinstance(arrays, Gaussians):
        return Gaussians(**{k: download(a) for k, a in arrays.arrays().items()})
    return type(arrays)(*map(download, arrays))


def forward(device, gaussians, camera, degree=3, **options):
    return host(ops.project_fwd(device, Renderer(device).place(gaussians), camera, degree, **options))


def backward(device, gaussians, camera, splats, v_splats, degree=3, **options):
    uploaded = [type(a)(*(device.upload("splats", x) for x in a)) for a in (splats, v_splats)]
    v, v_camera = ops.project_bwd(device, Renderer(device).place(gaussians), camera, degree, *uploaded, **options)
    return host(v), v_camera


def assert_cameras_match(actual, expected, tolerances):
    assert_matches("v_viewmat", actual.viewmat, expected.viewmat, tolerances)
    assert_matches("v_intrinsics", actual.intrinsics, expected.intrinsics, tolerances)


def random_grads(splats, seed=0):
    rng = np.random.default_rng(seed)
    return SplatGrads(*(rng.normal(size=getattr(splats, name).shape) for name in GRADIENTS))


def from_view(camera, points):
    """World coordinates of points (N, 3) in the camera's frame."""
    return (np.asarray(points) - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]


def wide_scene(n=1000, seed=5):
    """Gaussians everywhere: behind the camera, beyond the image's borders, close, far, faint; float32 values."""
    gaussians, camera = synthetic_scene(n, seed, width=97, height=61)
    rng = np.random.default_rng(seed)
    z = rng.uniform(-1, 8, n)
    slopes = rng.uniform(-1.2, 1.2, (n, 2)) * [1, camera.height / camera.width]
    gaussians.means[:] = from_view(camera, np.concatenate([slopes * z[:, None], z[:, None]], axis=1))
    gaussians.log_scales[:] = rng.uniform(np.log(0.003), np.log(0.6), (n, 3))
    gaussians.logit_opacities[:] = rng.uniform(-7, 5, n)
    gaussians.sh[:, 0] -= 0.5
    return gaussians.astype(np.float32), camera


@MODES
@pytest.mark.parametrize("degree", range(4))
def test_forward_matches_twin(device64, antialiased, degree):
    gaussians, camera = wide_scene()
    channels = 4 if antialiased else 3
    actual = forward(device64, gaussians, camera, degree, antialiased=antialiased, channels=channels)
    expected = reference.project_fwd(gaussians, camera, degree, antialiased=antialiased, channels=channels)
    shown = expected.extents[:, 0] > 0
    assert 0.2 < shown.mean() < 0.8 and (expected.colors[shown] == 0).any(), "the scene lacks a case"
    np.testing.assert_array_equal(actual.extents[:, 0] > 0, shown)
    for name in Splats._fields:
        assert_matches(name, getattr(actual, name), getattr(expected, name), DOUBLE)


@MODES
@pytest.mark.parametrize("degree", range(4))
def test_backward_matches_twin(device64, antialiased, degree):
    gaussians, camera = wide_scene()
    channels = 4 if antialiased else 3
    splats = reference.project_fwd(gaussians, camera, degree, antialiased=antialiased, channels=channels)
    v_splats = random_grads(splats)
    # The two variants of the kernel, with and without the viewmat, are one each here.
    options = {"antialiased": antialiased, "camera_grad": antialiased}
    actual, v_camera = backward(device64, gaussians, camera, splats, v_splats, degree, **options)
    expected, v_camera_expected = reference.project_bwd(gaussians, camera, degree, splats, v_splats, **options)
    for name, array in expected.arrays().items():
        assert_matches(f"v_{name}", actual.arrays()[name], array, DOUBLE)
    if antialiased:
        assert_cameras_match(v_camera, v_camera_expected, DOUBLE)
    else:
        assert v_camera is None and v_camera_expected is None


def random_moments(gaussians, rng):
    """Running means as of an optimisation that is under way; second ones are not negative."""
    shapes = {name: array.shape for name, array in gaussians.arrays().items()}
    first = Gaussians(**{name: rng.normal(size=shape) for name, shape in shapes.items()})
    return first, Gaussians(**{name: rng.uniform(0, 2, shape) for name, shape in shapes.items()})


@MODES
@pytest.mark.parametrize("penalties", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.4)])
@pytest.mark.parametrize(("stored", "degree"), [(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (3, 0), (3, 2), (3, 3)])
def test_update_matches_gradients_and_adam(any_device, antialiased, stored, degree, penalties):
    """The gradients in registers are those that project_bwd writes, and each meets its own moments, rate and penalty;
    invisible Gaussians move on by their moments alone."""
    gaussians, camera = wide_scene(300)
    gaussians.sh = gaussians.sh[:, : (stored + 1) ** 2]
    parts = (gaussians, *random_moments(gaussians, np.random.default_rng(stored)))
    splats = reference.project_fwd(gaussians, camera, degree, antialiased=antialiased)
    v_splats = random_grads(splats)
    step = adam_settings(20, 0.2, 2.0, OptimConfig(), degree)._replace(penalties=penalties)
    uploaded = [type(a)(*(any_device.upload("splats", x) for x in a)) for a in (splats, v_splats)]
    fused, separate = ([Renderer(any_device).place(part) for part in parts] for _ in range(2))
    # The gradient of the viewmat comes along on request; without it, the kernel is another.
    options = {"antialiased": antialiased, "camera_grad": degree == stored}
    v_fused = ops.project_bwd_adam(any_device, fused[0], tuple(fused[1:]), camera, *uploaded, step, **options)
    v, v_separate = ops.project_bwd(any_device, separate[0], camera, degree, *uploaded, **options)
    assert (v_fused is not None) == options["camera_grad"]
    if v_fused is not None:
        assert_cameras_match(v_fused, v_separate, DOUBLE if any_device.real == np.float64 else FLOAT)
    ops.adam_step(any_device, separate[0], v, *separate[1:], step, uploaded[0].extents)
    twin = [part.astype(np.float64) for part in parts]
    reference.project_bwd_adam(twin[0], tuple(twin[1:]), camera, splats, v_splats, step, antialiased=antialiased)

    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    for i, quantity in enumerate(("parameters", "first moments", "second moments")):
        for name, before in parts[i].arrays().items():
            found, expected = host(fused[i]).arrays()[name], host(separate[i]).arrays()[name]
            assert_matches(quantity, found, expected, tolerances)
            if any_device.real == np.float64:
                assert_matches(quantity, found, twin[i].arrays()[name], DOUBLE)
            assert (found != before).reshape(len(before), -1)[:, 0].mean() > 0.9, name
    hidden, moments = splats.extents[:, 0] == 0, host(fused[1])
    for name in ("log_scales", "logit_opacities"):  # of which the penalties are
        np.testing.assert_allclose(getattr(moments, name)[hidden], step.beta1 * getattr(parts[1], name)[hidden], 1e-6)


@pytest.fixture(scope="module", params=["as it is", "as a GPU"])
def configured_device64(request):
    """The float64 device, and one that the launches configure like a GPU."""
    device = open_device(np.float64)
    if request.param == "as a GPU":
        device.is_cpu = False  # shadows the cached property
    return device


@pytest.mark.parametrize("n", [1, 7, 8, 100])
@pytest.mark.parametrize("stored", [0, 1, 2, 3])
def test_any_number_of_gaussians(configured_device64, n, stored):
    """Vectors of Gaussians that are cut off by the end, and work-items that take one."""
    device = configured_device64
    gaussians, camera = wide_scene(1000)
    shown = reference.project_fwd(gaussians, camera, stored).extents[:, 0] > 0
    gaussians = gaussians.take(np.flatnonzero(shown)[:n])
    gaussians.sh = gaussians.sh[:, : (stored + 1) ** 2]
    parts = (gaussians, *random_moments(gaussians, np.random.default_rng(stored)))
    splats, expected = forward(device, gaussians, camera, stored), reference.project_fwd(gaussians, camera, stored)
    for name in Splats._fields:
        assert_matches(name, getattr(splats, name), getattr(expected, name), DOUBLE)

    v_splats = random_grads(expected)
    v, v_camera = backward(device, gaussians, camera, expected, v_splats, stored, camera_grad=True)
    v_expected, v_camera_expected = reference.project_bwd(
        gaussians, camera, stored, expected, v_splats, camera_grad=True
    )
    for name, array in v_expected.arrays().items():
        assert_matches(f"v_{name}", v.arrays()[name], array, DOUBLE)
    assert_cameras_match(v_camera, v_camera_expected, DOUBLE)

    step = adam_settings(20, 0.2, 2.0, OptimConfig(), stored)._replace(penalties=(0.3, 0.2, 0.4))
    found, twin = [Renderer(device).place(part) for part in parts], [part.astype(np.float64) for part in parts]
    uploaded = [type(a)(*(device.upload("splats", x) for x in a)) for a in (expected, v_splats)]
    ops.project_bwd_adam(device, found[0], tuple(found[1:]), camera, *uploaded, step)
    reference.project_bwd_adam(twin[0], tuple(twin[1:]), camera, expected, v_splats, step)
    for i, quantity in enumerate(("parameters", "first moments", "second moments")):
        for name, array in twin[i].arrays().items():
            assert_matches(quantity, host(found[i]).arrays()[name], array, DOUBLE)


@MODES
def test_float_matches_twin(device, antialiased):
    gaussians, camera = wide_scene()
    # Depths just above the near plane lose their digits to the camera's distance from the origin.
    z = gaussians.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    gaussians = gaussians.take((z < 0) | (z > 0.2))
    options = {"antialiased": antialiased, "channels": 4 if antialiased else 3}
    actual = forward(device, gaussians, camera, **options)
    expected = reference.project_fwd(gaussians, camera, 3, **options)
    same = (actual.extents[:, 0] > 0) == (expected.extents[:, 0] > 0)
    # A flip needs the edge of an extent within 1e-5 px of a pixel's centre: one row in 1e4.
    assert (~same).sum() <= 1
    for name in Splats._fields:
        assert_matches(name, getattr(actual, name), getattr(expected, name), FLOAT, where=same)

    v_splats = random_grads(expected)
    options = {"antialiased": antialiased, "camera_grad": antialiased}
    v_actual, v_camera = backward(device, gaussians, camera, expected, v_splats, **options)
    v_expected, v_camera_expected = reference.project_bwd(gaussians, camera, 3, expected, v_splats, **options)
    for name, array in v_expected.arrays().items():
        assert_matches(f"v_{name}", v_actual.arrays()[name], array, FLOAT)
    if antialiased:
        assert_cameras_match(v_camera, v_camera_expected, FLOAT)


def check_gradients(device, gaussians, camera, antialiased, degree=3):
    """Central differences of a random linear function of what is differentiable, by every input."""
    options = {"antialiased": antialiased, "channels": 4}
    splats = forward(device, gaussians, camera, degree, **options)
    assert (splats.extents > 0).all(), "every Gaussian must be visible"
    v_splats = random_grads(splats)

    def scalar(viewmat, intrinsics, **arrays):
        moved_camera = replace(camera, viewmat=viewmat, **dict(zip(INTRINSICS, intrinsics, strict=True)))
        moved = forward(device, Gaussians(**arrays), moved_camera, degree, **options)
        # Differences of the outputs, lest those that are large and do not change drown the rest in rounding.
        return sum(float(((getattr(moved, k) - getattr(splats, k)) * getattr(v_splats, k)).sum()) for k in GRADIENTS)

    v, v_camera = backward(
        device, gaussians, camera, splats, v_splats, degree, antialiased=antialiased, camera_grad=True
    )
    inputs = {"viewmat": camera.viewmat, "intrinsics": np.array([getattr(camera, k) for k in INTRINSICS])}
    gradcheck(scalar, gaussians.arrays() | inputs, v.arrays() | v_camera._asdict())
    return v


@MODES
@pytest.mark.parametrize("degree", [0, 3])
def test_central_differences(device64, antialiased, degree):
    gaussians, camera = synthetic_scene(75, seed=1, margin=1e-3)
    shown = reference.project_fwd(gaussians, camera, degree, antialiased=antialiased).extents[:, 0] > 0
    gaussians = gaussians.take(shown)
    assert len(gaussians) > 64, "the viewmat's gradient must be summed over more than one work-group"
    v = check_gradients(device64, gaussians, camera, antialiased, degree)
    assert (v.sh[:, (degree + 1) ** 2 :] == 0).all(), "bands that are not evaluated have no gradient"


@MODES
def test_central_differences_in_the_clamped_zone(device64, antialiased):
    """Large Gaussians outside the enlarged image, beyond each border and each corner, still reach into it."""
    gaussians, camera = synthetic_scene(8, seed=2)
    limits = (0.5 + 0.5 * FRUSTUM_MARGIN) * np.array([camera.width / camera.fx, camera.height / camera.fy])
    sides = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)])
    z = np.linspace(2, 4, 8)[:, None]
    slopes = 1.2 * limits * sides
    gaussians.means[:] = from_view(camera, np.concatenate([slopes * z, z], axis=1))
    gaussians.log_scales[:] = np.random.default_rng(2).uniform(-0.3, 0.3, (8, 3))
    points = gaussians.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    outside = np.abs(points[:, :2] / points[:, 2:]) / limits
    assert ((outside > 1.1) == (sides != 0)).all() and ((outside < 0.9) == (sides == 0)).all()
    check_gradients(device64, gaussians, camera, antialiased)


@MODES
def test_central_differences_at_the_clamps(device64, antialiased):
    """Colours clamped at 0 in one, two or three channels, and a compensation at its floor."""
    gaussians, camera = synthetic_scene(6, seed=3, margin=0.02)
    gaussians.sh[0, 0, 0] = gaussians.sh[1, 0, 1:] = gaussians.sh[2, 0] = -8
    # A speck of opacity 0.00475 is seen at a pixel's centre only.
    gaussians.means[3] = from_view(camera, [4 * 2 / camera.fx, 4 * 1 / camera.fy, 4])
    gaussians.log_scales[3] = -8
    gaussians.logit_opacities[3] = logit(0.95)
    splats = reference.project_fwd(gaussians, camera, 3, antialiased=antialiased)
    assert (splats.colors[:3] == 0).sum() == 6
    if antialiased:
        assert splats.opacities[3] == pytest.approx(0.95 * COMPENSATION_MIN, rel=1e-12)
    v = check_gradients(device64, gaussians, camera, antialiased)
    assert (v.sh[2] == 0).all() and (v.sh[0, :, 0] == 0).all() and (v.sh[0, :, 1] != 0).all()


def test_the_scene_keeps_its_margin():
    gaussians, camera = synthetic_scene(30, seed=1, margin=1e-3)
    for antialiased in (False, True):
        assert threshold_distances(gaussians, camera, antialiased=antialiased).min() >= 1e-3


def test_disparities_match_twin(any_device):
    gaussians, camera = wide_scene()
    if any_device.real == np.float32:  # as in test_float_matches_twin
        z = gaussians.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        gaussians = gaussians.take((z < 0) | (z > 0.2))
    splats = reference.project_fwd(gaussians, camera, 0)
    uploaded = Splats(*(any_device.upload("splats", a) for a in splats))
    found = ops.project_disparities(any_device, Renderer(any_device).place(gaussians), camera, uploaded).get()
    expected = reference.project_disparities(gaussians, camera, splats)
    table = DOUBLE if any_device.real == np.float64 else FLOAT
    for column in range(3):
        assert_matches("disparities", found[:, column], expected[:, column], table)
    assert (found[splats.extents[:, 0] == 0] == 0).all()


def test_disparities_are_where_a_ray_meets_the_gaussian():
    """Discs are met in their plane; along any ray a Gaussian is densest where the sum of squares is least."""
    gaussians, camera = synthetic_scene(40, seed=3, width=970, height=610)  # large in pixels: the blur is nothing
    gaussians.log_scales[:] = np.log([0.2, 0.1, 1e-4])
    splats = reference.project_fwd(gaussians, camera, 0)
    disparities = reference.project_disparities(gaussians, camera, splats)
    axes = reference_rotations(gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True))
    checked = 0
    for g in np.flatnonzero(splats.extents[:, 0] > 0):
        offset = 0.2 * splats.extents[g]
        pixel = splats.means2d[g] + offset
        ray = np.append((pixel - [camera.cx, camera.cy]) / [camera.fx, camera.fy], 1)
        whiten = (camera.viewmat[:3, :3] @ axes[g]) / gaussians.scales[g]
        point = camera.viewmat[:3, :3] @ gaussians.means[g] + camera.viewmat[:3, 3]
        towards, centre = ray @ whiten, point @ whiten
        expected = (towards @ towards) / (towards @ centre)
        if np.linalg.norm(whiten[:, 2] * 1e-4 @ [0, 0, 1]) < 0.3:
            continue  # edge on: the blur counts
        assert disparities[g] @ [1, *offset] == pytest.approx(expected, rel=2e-3)
        checked += abs(expected * splats.depths[g] - 1) > 0.01
    assert checked > 10, "the centre's depth would do"


def test_nothing_of_the_box_is_lost():
    """The extents are those of {alpha >= ALPHA_MIN}: on the box's border alpha is ALPHA_MIN but for the slack."""
    gaussians, camera = wide_scene()
    splats = reference.project_fwd(gaussians, camera, 3)
    shown = splats.extents[:, 0] > 0
    (a, b, c), extents = splats.conics[shown].T, splats.extents[shown]
    # At the rightmost point dy = -(b/c) dx; sigma there is dx^2 (a - b^2/c)/2.
    sigma = 0.5 * extents[:, 0] ** 2 * (a - b * b / c)
    alpha = splats.opacities[shown] * np.exp(-sigma)
    np.testing.assert_allclose(alpha, ALPHA_MIN * np.exp(-1e-3), rtol=1e-6)


def test_twin_in_numbers():
    """By hand: a sphere off the axis of a camera at the origin."""
    camera = Camera(np.eye(4), 100, 50, 32, 24, 64, 48)
    gaussians, _ = synthetic_scene(1)
    gaussians.means[0] = (0.5, -0.25, 5)
    gaussians.log_scales[0] = np.log(0.2)
    splats = reference.project_fwd(gaussians, camera, 0)
    np.testing.assert_allclose(splats.means2d[0], (42, 21.5))
    # On the axis a sphere's covariance is (f s/z)^2; off it the Jacobian's third column adds (f s x/z^2)^2.
    xx, yy = 16 * (1 + 0.01) + 0.3, 4 * (1 + 0.0025) + 0.3
    xy = 100 * 50 * 0.04 * 0.5 * -0.25 / 5**4
    inverse = np.linalg.inv([[xx, xy], [xy, yy]])
    np.testing.assert_allclose(splats.conics[0], inverse[[0, 0, 1], [0, 1, 1]], rtol=1e-12)
    np.testing.assert_allclose(splats.colors[0], np.maximum(0.5 + 0.28209479177387814 * gaussians.sh[0, 0], 0))
