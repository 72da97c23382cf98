"""Stage filter: against the twin, against central differences, on degenerate input."""

from dataclasses import replace

import numpy as np
import pytest
from test_project import host, wide_scene
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.camera import Camera
from clsplat.constants import FILTER_VARIANCE
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.testing import assert_matches, gradcheck, synthetic_scene

NAMES = ("log_scales", "logit_opacities")


def forward(device, gaussians, pixels):
    return host(ops.filter_fwd(device, Renderer(device).place(gaussians), device.upload("pixels", pixels)))


def backward(device, gaussians, pixels, v):
    v = Gaussians(**{name: device.upload("v", array) for name, array in v.arrays().items()})
    return host(ops.filter_bwd(device, Renderer(device).place(gaussians), device.upload("pixels", pixels), v))


def scene(n=400):
    """Gaussians from far below to far above the size of a pixel, some without a filter."""
    gaussians = wide_scene(n)[0]
    rng = np.random.default_rng(0)
    gaussians.log_scales[:] = rng.uniform(-9, 1, (n, 3))
    pixels = np.exp(rng.uniform(-7, -2, n)).astype(np.float32)
    pixels[::7] = 0
    return gaussians, pixels


def random_grads(gaussians, seed=0):
    rng = np.random.default_rng(seed)
    return Gaussians(**{name: rng.normal(size=array.shape) for name, array in gaussians.arrays().items()})


def ring(n, radius, width=60):
    angles = 2 * np.pi * np.arange(n) / n
    return [Camera.look_at((radius * np.sin(a), 0, radius * np.cos(a)), (0, 0, 0), (0, -1, 0), 50 + 9 * i, width, 40)
            for i, a in enumerate(angles)]  # fmt: skip


def test_sizes_match_twin(any_device):
    gaussians, _ = scene()
    gaussians.means *= 3  # some are seen by no camera, and some by all
    cameras = ring(5, 4)
    found = ops.pixel_sizes(any_device, Renderer(any_device).place(gaussians), cameras).get()
    expected = reference.pixel_sizes(gaussians, cameras)
    # The edge of an image may be on either side of a centre: one row in 1e4.
    assert (np.abs(found / expected - 1) > 1e-5).sum() <= (1 if any_device.real == np.float32 else 0)
    seen = [(reference.pixel_sizes(gaussians, [c]) < reference.pixel_sizes(gaussians, [c]).max()) for c in cameras]
    assert 0 < np.any(seen, axis=0).mean() < 1


def test_sizes_in_numbers(any_device):
    """By hand: the camera that samples most finely counts, which is the nearer one or the one of longer focal length;
    one that looks away does not."""
    camera = Camera(np.eye(4), 100, 90, 32, 24, 64, 48)
    nearer = replace(camera, viewmat=np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2], [0, 0, 0, 1.0]]))
    away = replace(camera, viewmat=np.diag([-1.0, 1, -1, 1]), fx=1e4)
    gaussians = synthetic_scene(3)[0]
    gaussians.means[:] = [(0, 0, 5), (0, 0, 1.5), (0, 0, -5)]
    cameras = [camera, nearer, away]
    found = [
        ops.pixel_sizes(any_device, Renderer(any_device).place(gaussians), c).get()
        for c in (cameras[:2], cameras, [])
    ]
    np.testing.assert_allclose(found[0], [0.03, 0.015, 0.03], rtol=1e-6)
    np.testing.assert_allclose(found[1], [0.03, 0.015, 0.0005], rtol=1e-6)
    np.testing.assert_array_equal(found[2], 0)
    np.testing.assert_allclose(reference.pixel_sizes(gaussians, cameras), found[1], rtol=1e-6)


def test_filter_matches_twin(any_device):
    gaussians, pixels = scene()
    table = DOUBLE if any_device.real == np.float64 else FLOAT
    found, expected = forward(any_device, gaussians, pixels), reference.filter_fwd(gaussians, pixels)
    for name in NAMES:
        assert_matches(f"filtered {name}", getattr(found, name), getattr(expected, name), table)
    v = random_grads(gaussians)
    expected = reference.filter_bwd(gaussians, pixels, v.astype(np.float64))
    found = backward(any_device, gaussians, pixels, v)
    for name in NAMES:
        assert_matches(f"v_{name}", getattr(found, name), getattr(expected, name), table)
    np.testing.assert_array_equal(found.means, v.means.astype(any_device.real))


def test_the_filter_is_a_convolution():
    """Scales add in squares, and the integral of opacity times density stays."""
    gaussians, pixels = scene()
    g, f = gaussians.astype(np.float64), reference.filter_fwd(gaussians, pixels)
    np.testing.assert_allclose(f.scales**2, g.scales**2 + FILTER_VARIANCE * pixels[:, None].astype(float) ** 2)
    mass = [h.opacities * h.scales.prod(axis=1) for h in (g, f)]
    np.testing.assert_allclose(mass[1], mass[0], rtol=1e-6)


def test_central_differences(device64):
    gaussians, pixels = scene(60)
    gaussians = gaussians.astype(np.float64)
    v_out = random_grads(gaussians)

    def scalar(**moved):
        out = forward(device64, replace(gaussians, **moved), pixels)
        return float(sum((getattr(out, k) * getattr(v_out, k)).sum() for k in NAMES))

    v = backward(device64, gaussians, pixels, v_out)
    inputs = {name: getattr(gaussians, name) for name in NAMES}
    gradcheck(scalar, inputs, {name: getattr(v, name) for name in NAMES})


@pytest.mark.parametrize("pixel", [0.0, 1e-20, 1e-3, 1e6])
def test_extremes_stay_finite_and_what_is_invalid_stays(any_device, pixel):
    values = [-np.inf, -100, -20, 0, 12, 40, np.inf, np.nan]
    log_scales, logits = (a.ravel() for a in np.meshgrid(values, [-np.inf, -200, -5, 0, 20, 200, np.inf, np.nan]))
    gaussians = synthetic_scene(1)[0].take(np.zeros(len(logits), int))
    gaussians.log_scales[:], gaussians.logit_opacities[:] = log_scales[:, None], logits
    pixels = np.full(len(logits), pixel)
    found = forward(any_device, gaussians, pixels)
    for name, before in (("log_scales", log_scales), ("logit_opacities", logits)):
        after = getattr(found, name).reshape(len(logits), -1)[:, 0]
        valid = np.isfinite(logits) & ~np.isnan(log_scales)
        if name == "log_scales":
            valid = np.isfinite(log_scales) if pixel == 0 else log_scales < np.inf
        assert np.isfinite(after[valid]).all(), name
        np.testing.assert_array_equal(after[~np.isfinite(before) & ~valid], before[~np.isfinite(before) & ~valid])
    v = backward(any_device, gaussians, pixels, random_grads(gaussians))
    healthy = (log_scales < np.inf) & np.isfinite(logits)
    assert np.isfinite(v.log_scales[healthy]).all() and np.isfinite(v.logit_opacities[healthy]).all()
