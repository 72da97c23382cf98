"""Stage dropout: shares and means of the draws, the kernel against the twin, and gradients through an image."""

from dataclasses import replace

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer, fetch
from clsplat.stages import Dropout, Image, RaySplats, SplatGrads, Splats
from clsplat.testing import assert_matches, gradcheck, synthetic_scene


def splats_of(n, seed=0):
    gaussians, camera = synthetic_scene(n, seed, width=160, height=120)
    gaussians.logit_opacities[::7] = -5.4  # just above ALPHA_MIN
    return reference.project_fwd(gaussians, camera, 3)


def by_kernel(device, splats, dropout):
    on_device = Splats(*(device.upload("splats", a) for a in splats))
    ops.dropout_fwd(device, on_device, dropout)
    return Splats(*(a.get() for a in on_device))


def by_twin(splats, dropout):
    result = Splats(*(a.copy() for a in splats))
    reference.dropout_fwd(result, dropout)
    return result


@pytest.mark.parametrize("far", [np.inf, 4.0])
@pytest.mark.parametrize("n", [1, 65, 2000])
def test_matches_twin(any_device, n, far):
    splats, dropout = splats_of(n), Dropout(0.3, 2**40 + 7, 1234, far)
    found, expected = by_kernel(any_device, splats, dropout), by_twin(splats, dropout)
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    for name in Splats._fields:
        assert_matches(name, getattr(found, name), getattr(expected, name), tolerances)
    assert ((found.opacities > 0) == (expected.opacities > 0)).all()


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.5])
def test_the_share_that_is_dropped_and_the_mean_of_the_others(rate):
    splats = splats_of(2000)
    shown = splats.extents[:, 0] > 0
    sums = np.zeros(len(shown))
    for iteration in range(200):
        after = by_twin(splats, Dropout(rate, 0, iteration))
        kept = after.extents[:, 0] > 0
        assert not (kept & ~shown).any()
        sums += after.opacities
        # Five standard deviations of a share of 1600 draws.
        assert abs(1 - kept.sum() / shown.sum() - rate) <= 5 * np.sqrt(rate * (1 - rate) / shown.sum())
    np.testing.assert_allclose(sums.mean() / 200, splats.opacities.mean(), rtol=0.01)


def test_splats_beyond_the_depth_stay_as_they_are():
    splats = splats_of(2000)
    far = float(np.median(splats.depths[splats.extents[:, 0] > 0]))
    after, beyond = by_twin(splats, Dropout(0.5, 0, 1, far)), splats.depths > far
    assert 100 < (beyond & (splats.opacities > 0)).sum()
    for name in Splats._fields:
        np.testing.assert_array_equal(getattr(after, name)[beyond], getattr(splats, name)[beyond])
    shown = ~beyond & (splats.opacities > 0)
    assert 0.4 < (after.opacities[shown] > 0).mean() < 0.6


def test_boxes_are_those_of_the_new_opacity():
    """As if the Gaussians themselves had it."""
    gaussians, camera = synthetic_scene(500, width=160, height=120)
    dropout = Dropout(0.2, 0, 1)
    found = by_twin(reference.project_fwd(gaussians, camera, 3), dropout)
    kept = found.extents[:, 0] > 0
    opaque = gaussians.opacities * dropout.gain
    possible = kept & (opaque < 1)
    gaussians.logit_opacities[possible] = np.log(opaque[possible] / (1 - opaque[possible]))
    expected = reference.project_fwd(gaussians, camera, 3)
    assert possible.sum() > 100
    np.testing.assert_allclose(found.extents[possible], expected.extents[possible], rtol=1e-9)


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_images_along_rays_are_those_of_the_new_opacity(device64, model):
    """Of one Gaussian whose outline is not in proportion to the root of r2, because it is long towards the camera."""
    viewmat, dropout = np.eye(4), Dropout(0.5, 3, 1)  # which keeps it
    viewmat[2, 3] = 1
    camera = Camera(viewmat, 200, 200, 200, 150, 400, 300, model=model, near=0.01)
    renderer = Renderer(device64, RenderConfig(projection="ray", tile_size=8))
    for x in (0.1, 0.3, 0.5):
        images = []
        for opacity, options in ((0.4, {"dropout": dropout}), (0.8, {})):
            logit = np.log([opacity / (1 - opacity)])
            scales = np.log([[0.03, 0.03, 0.28]])
            one = Gaussians(np.array([[x, 0, 0]]), scales, np.eye(4)[:1], logit, np.ones((1, 1, 3)))
            run = renderer.forward(one, camera, **options)
            images.append(run.image.alpha.get())
        assert images[1].max() > 0.7
        np.testing.assert_allclose(images[0], images[1], atol=1e-12)


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_along_rays_matches_twin(any_device, model):
    gaussians, camera = synthetic_scene(500, width=160, height=120)
    dropout = Dropout(0.3, 7, 9)
    splats = reference.project_fwd(gaussians, replace(camera, model=model), 3, rays=True, gain=dropout.gain)
    found = RaySplats(*(any_device.upload("splats", a) for a in splats))
    ops.dropout_fwd(any_device, found, dropout)
    expected = RaySplats(*(a.copy() for a in splats))
    reference.dropout_fwd(expected, dropout)
    kept = (expected.extents > 0).all(axis=1)
    assert 0.6 < kept.sum() / (splats.extents[:, 0] > 0).sum() < 0.8
    np.testing.assert_array_equal(expected.extents[kept], splats.extents[kept])
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    for name in ("extents", "opacities"):
        assert_matches(name, getattr(found, name).get(), getattr(expected, name), tolerances)


def test_each_iteration_and_seed_draws_anew(device):
    splats = splats_of(2000)
    draws = [by_kernel(device, splats, Dropout(0.5, *use)).opacities > 0 for use in ((0, 1), (0, 2), (1, 1), (0, 1))]
    for other in draws[1:3]:
        assert 0.3 < (draws[0] != other)[splats.opacities > 0].mean() < 0.7
    assert (draws[0] == draws[3]).all()


def test_gradients_through_the_image(device64):
    gaussians, camera = synthetic_scene(12, seed=2, margin=3e-2)
    gaussians.logit_opacities -= 1  # the others' opacities stay below ALPHA_MAX
    dropout, renderer = Dropout(0.3, 0, 5, far=4.5), Renderer(device64, background=(0.1, 0.5, 0.9))
    weights = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3))

    def run(logit_opacities, means):
        arrays = {**gaussians.arrays(), "logit_opacities": logit_opacities, "means": means}
        return renderer.forward(type(gaussians)(**arrays), camera, dropout=dropout)

    first = run(gaussians.logit_opacities, gaussians.means)
    dropped = first.splats.opacities.get() == 0
    assert 0 < dropped.sum() < 12
    v = Image(device64.upload("v", weights), device64.upload("v", np.zeros(weights.shape[:2])))
    gradients = fetch(renderer.backward(first, v).gaussians)
    assert (gradients.logit_opacities[dropped] == 0).all() and (gradients.logit_opacities[~dropped] != 0).any()
    gradcheck(
        lambda **inputs: float((run(**inputs).image.rgb.get() * weights).sum()),
        {"logit_opacities": gaussians.logit_opacities, "means": gaussians.means},
        {"logit_opacities": gradients.logit_opacities, "means": gradients.means},
    )


def test_backward_matches_twin(any_device):
    v, depths = np.random.default_rng(0).normal(size=70), np.arange(70.0)
    dropout = Dropout(0.25, 0, 1, far=49)
    splats = Splats(None, None, any_device.upload("depths", depths), None, None, None)
    arrays = SplatGrads(None, None, any_device.upload("v", v), None)
    ops.dropout_bwd(any_device, splats, arrays, dropout)
    expected = SplatGrads(None, None, v.copy(), None)
    reference.dropout_bwd(splats._replace(depths=depths), expected, dropout)
    np.testing.assert_allclose(arrays.opacities.get(), expected.opacities, rtol=1e-6)
    np.testing.assert_allclose(expected.opacities[:50], v[:50] / 0.75)
    np.testing.assert_array_equal(expected.opacities[50:], v[50:])
