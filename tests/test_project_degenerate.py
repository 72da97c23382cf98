"""Stage project on degenerate input: NaN, infinities, zeros, extremes, the near plane."""

from dataclasses import replace

import numpy as np
import pytest
from test_project import GRADIENTS, MODES, assert_cameras_match, backward, forward, random_grads
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.camera import Camera
from clsplat.constants import ALPHA_MIN, NEAR
from clsplat.gaussians import Gaussians, logit
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.stages import SplatGrads, Splats
from clsplat.testing import synthetic_scene

NAN, INF = np.nan, np.inf
INVISIBLE = {
    "mean is NaN": ("means", (NAN, 0, 0)),
    "mean is infinite": ("means", (INF, 0, 0)),
    "mean is minus infinite": ("means", (0, -INF, 0)),
    "scale is NaN": ("log_scales", (0, NAN, 0)),
    "scale is infinite": ("log_scales", (0, 0, INF)),
    "scale overflows": ("log_scales", (800, 0, 0)),
    "quaternion is zero": ("quats", (0, 0, 0, 0)),
    "quaternion is denormal": ("quats", (1e-40, 0, 0, 1e-41)),
    "quaternion is NaN": ("quats", (1, NAN, 0, 0)),
    "quaternion is infinite": ("quats", (1, 0, INF, 0)),
    "opacity is NaN": ("logit_opacities", NAN),
    "opacity is 0": ("logit_opacities", -INF),
    "opacity is too small to see": ("logit_opacities", logit(ALPHA_MIN * 0.99)),
    "colour is NaN": ("sh", NAN),
    "colour is infinite": ("sh", -INF),
}
VISIBLE = {
    "scale is 0": ("log_scales", (-INF, -INF, -INF)),
    "scale is denormal": ("log_scales", (-100, -3, -100)),
    "scale is huge": ("log_scales", (12, 12, 12)),
    "needle": ("log_scales", (2, -18, -18)),
    "disc": ("log_scales", (0, 0, -40)),
    "quaternion is large": ("quats", (1e15, 3e15, 0, 1e15)),
    "quaternion is small": ("quats", (1.1e-4, 0, 0, 1e-5)),
    "opacity is 1": ("logit_opacities", INF),
    "opacity rounds to 1": ("logit_opacities", 200.0),
    "colour is huge": ("sh", 1e10),
    "colour is denormal": ("sh", 1e-40),
}


def poisoned(gaussians, rows):
    """The Gaussians with one more row for each entry of `rows`, a copy of row 0 changed in one field, put between."""
    parts, poison = [], []
    for k, (field, value) in enumerate(rows.values()):
        bad = gaussians.take([0])
        getattr(bad, field)[0] = value
        poison.append(sum(map(len, parts)) + 1)
        parts += [gaussians.take([k % len(gaussians)]), bad]
    parts.append(gaussians.take(np.arange(len(rows), len(gaussians))))
    mixed = Gaussians.concatenate(parts)
    healthy = np.setdiff1d(np.arange(len(mixed)), poison)
    return mixed, healthy, np.array(poison)


@MODES
def test_invalid_gaussians_are_invisible(any_device, antialiased):
    gaussians, camera = synthetic_scene(40, seed=4, width=97, height=61)
    gaussians.means[0] = 0
    mixed, healthy, poison = poisoned(gaussians, INVISIBLE)
    mixed = mixed.astype(any_device.real)
    options = {"antialiased": antialiased, "channels": 4}
    clean, splats = (forward(any_device, g, camera, **options) for g in (mixed.take(healthy), mixed))
    twin = reference.project_fwd(mixed, camera, 3, **options)
    assert clean.extents[0, 0] > 0, "the row that is poisoned must be visible when healthy"
    for name in Splats._fields:
        rows = getattr(splats, name)
        assert (rows[poison] == 0).all() and (getattr(twin, name)[poison] == 0).all(), name
        np.testing.assert_array_equal(rows[healthy], getattr(clean, name), err_msg=name)

    # Nor do they pass a gradient on, to themselves or to the camera, whatever arrives.
    v_splats = random_grads(clean)
    for grads in (splats, twin):
        v_mixed = SplatGrads(*(np.full(getattr(grads, k).shape, 1e3) for k in GRADIENTS))
        for name in GRADIENTS:
            getattr(v_mixed, name)[healthy] = getattr(v_splats, name)
    options = {"antialiased": antialiased, "camera_grad": True}
    v_clean, v_camera_clean = backward(any_device, mixed.take(healthy), camera, clean, v_splats, **options)
    v, v_camera = backward(any_device, mixed, camera, splats, v_mixed, **options)
    v_twin, v_camera_twin = reference.project_bwd(mixed, camera, 3, twin, v_mixed, **options)
    table = DOUBLE if any_device.real == np.float64 else FLOAT
    for name, array in v.arrays().items():
        assert (array[poison] == 0).all() and (v_twin.arrays()[name][poison] == 0).all(), name
        np.testing.assert_array_equal(array[healthy], v_clean.arrays()[name], err_msg=name)
    assert_cameras_match(v_camera, v_camera_clean, table)  # summed in other groups
    assert_cameras_match(v_camera, v_camera_twin, table)


@MODES
def test_extreme_gaussians_stay_finite(any_device, antialiased):
    gaussians, camera = synthetic_scene(40, seed=4, width=97, height=61)
    gaussians.means[0] = 0
    gaussians.logit_opacities[0] = 4
    mixed, healthy, extreme = poisoned(gaussians, VISIBLE)
    mixed = mixed.astype(any_device.real)
    options = {"antialiased": antialiased, "channels": 4}
    splats = forward(any_device, mixed, camera, **options)
    assert (splats.extents[extreme] > 0).all()
    v_splats = random_grads(splats)
    v, v_camera = backward(any_device, mixed, camera, splats, v_splats, antialiased=antialiased, camera_grad=True)
    for name, array in [*splats._asdict().items(), *v.arrays().items(), *v_camera._asdict().items()]:
        assert np.isfinite(array).all(), name
    clean = forward(any_device, mixed.take(healthy), camera, **options)
    for name in Splats._fields:
        np.testing.assert_array_equal(getattr(splats, name)[healthy], getattr(clean, name), err_msg=name)
    uploaded = Splats(*(any_device.upload("splats", a) for a in splats))
    disparities = ops.project_disparities(any_device, Renderer(any_device).place(mixed), camera, uploaded).get()
    assert np.isfinite(disparities).all() and (disparities[:, 0] >= 0).all()


def test_quaternion_whose_norm_overflows_is_invisible(any_device):
    gaussians, camera = synthetic_scene(3, seed=4)
    gaussians.quats[1] *= 1e30 if any_device.real == np.float32 else 1e200
    splats = forward(any_device, gaussians.astype(any_device.real), camera)
    np.testing.assert_array_equal(splats.extents[:, 0] > 0, [1, 0, 1])


def test_near_plane_and_behind(any_device):
    """Depths on both sides of the near plane, at it, at 0 and behind the camera; far away; off screen."""
    gaussians, camera = synthetic_scene(9, seed=6, width=97, height=61)
    camera = replace(camera, viewmat=np.eye(4))
    z = np.array([NEAR * (1 + 1e-5), NEAR * (1 - 1e-5), 0, -NEAR, -3, 1e-40, 1e6, 1e30, 2])
    gaussians.means[:] = np.stack([0 * z, 0 * z, z], axis=1)
    gaussians.means[8] = (100, 0, 2)
    gaussians.log_scales[8] = -3
    splats = forward(any_device, gaussians.astype(any_device.real), camera, channels=4)
    np.testing.assert_array_equal(splats.extents[:, 0] > 0, [1, 0, 0, 0, 0, 0, 1, 1, 0])
    v, v_camera = backward(any_device, gaussians, camera, splats, random_grads(splats), camera_grad=True)
    for name, array in [*splats._asdict().items(), *v.arrays().items(), *v_camera._asdict().items()]:
        assert np.isfinite(array).all(), name


def test_gradients_that_overflow_are_zero(device):
    """A colour of 3e38, seen from afar: Adam's moments would be NaN for good (found by fuzzing)."""
    gaussians, camera = synthetic_scene(20, sh_degree=0)
    scene = gaussians.astype(np.float32)
    scene.sh[3] = 3e38
    rendering = render(scene, camera, device=device)
    gradients = rendering.backward(np.ones_like(rendering.rgb), viewmat_grad=True)
    for name, array in gradients.gaussians.arrays().items():
        assert np.isfinite(array).all(), name
        assert not array[3].any(), name
    assert np.abs(gradients.gaussians.means).max() > 0
    assert np.isfinite(gradients.viewmat).all()


@pytest.mark.parametrize("axis", [0, 1])
def test_a_gradient_of_one_number_that_overflows_is_zero(any_device, axis):
    """A ball on the camera's axis, whose gradient moves it along one axis of the world and changes nothing else."""
    ball = synthetic_scene(1, sh_degree=0)[0]
    ball.means[:], ball.quats[:], ball.log_scales[:] = (0, 0, 2), (1, 0, 0, 0), np.log(0.1)
    camera = Camera(np.eye(4), 200, 200, 32, 32, 64, 64)
    splats = reference.project_fwd(ball, camera, 0)
    largest = np.finfo(any_device.real).max
    v_splats = SplatGrads(*(np.zeros(getattr(splats, name).shape) for name in GRADIENTS))
    v_splats.means2d[0, axis] = largest / 2
    v, _ = backward(any_device, ball, camera, splats, v_splats, degree=0)
    assert all((array == 0).all() for array in v.arrays().values())
    v_splats.means2d[0, axis] = largest / 1000
    v, _ = backward(any_device, ball, camera, splats, v_splats, degree=0)
    assert np.isfinite(v.means).all() and v.means[0, axis] > largest / 100
