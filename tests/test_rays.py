"""Stage rays: closed forms, the same image as compositing of splats, against the twin and central differences."""

from functools import partial

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.constants import TRANSMITTANCE_MIN
from clsplat.stages import Splats
from clsplat.testing import assert_matches, gradcheck

BACKGROUND = (0.2, 0.5, 0.9)


def samples(rays=37, seed=0, density=3.0):
    """Rays of 0 to 60 samples; exact in single precision."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 60, rays)
    counts[0] = 0
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)
    n = int(first[-1])
    arrays = rng.exponential(density, n), rng.uniform(size=(n, 3)), rng.uniform(0.005, 0.05, n)
    sigmas, colors, deltas = (a.astype(np.float32).astype(np.float64) for a in arrays)
    return sigmas, colors, deltas, first


def by_kernel(device, sigmas, colors, deltas, first, v_rgb=None):
    arrays = [device.upload("samples", a) for a in (sigmas, colors, deltas)]
    place = device.upload("first", first, np.uint32)
    image = ops.rays_fwd(device, *arrays, place, BACKGROUND)
    results = [a.get() for a in image]
    if v_rgb is not None:
        v = device.upload("v_rgb", v_rgb)
        results += [a.get() for a in ops.rays_bwd(device, *arrays, place, BACKGROUND, image.transmittances, v)]
    return results


def by_twin(sigmas, colors, deltas, first, v_rgb=None):
    image = reference.rays_fwd(sigmas, colors, deltas, first, BACKGROUND)
    if v_rgb is None:
        return list(image)
    return [*image, *reference.rays_bwd(sigmas, colors, deltas, first, BACKGROUND, image.transmittances, v_rgb)]


@pytest.mark.parametrize("density", [3.0, 60.0], ids=["thin", "opaque"])
def test_matches_twin(any_device, density):
    given = samples(density=density)
    v_rgb = np.random.default_rng(1).normal(size=(37, 3)).astype(np.float32).astype(np.float64)
    expected = by_twin(*given, v_rgb)
    # Rays that end early, or none: both happen, and not within rounding of the threshold.
    assert (expected[2] < TRANSMITTANCE_MIN).any() == (density > 10)
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    names = ("ray colours", "transmittances", "transmittances", "v_sigmas", "v_ray colours")
    for name, found, wanted in zip(names, by_kernel(any_device, *given, v_rgb), expected, strict=True):
        assert_matches(name, found, wanted, tolerances)


def test_each_ray_may_have_its_own_background(any_device):
    """Colours and gradients are those of the twin; with equal backgrounds, those of one background to the bit."""
    given, rng = samples(), np.random.default_rng(5)
    v_rgb, own = (rng.uniform(size=(37, 3)).astype(np.float32).astype(np.float64) for _ in range(2))
    on_device = [any_device.upload("samples", a) for a in given[:3]]
    on_device.append(any_device.upload("first", given[3], np.uint32))
    v = any_device.upload("v_rgb", v_rgb)

    def run(background):
        there = any_device.upload("background", background)
        image = ops.rays_fwd(any_device, *on_device, there)
        return image.rgb.get(), *(
            a.get() for a in ops.rays_bwd(any_device, *on_device, there, image.transmittances, v)
        )

    image = reference.rays_fwd(*given, own)
    expected = image.rgb, *reference.rays_bwd(*given, own, image.transmittances, v_rgb)
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    for name, found, wanted in zip(("ray colours", "v_sigmas", "v_ray colours"), run(own), expected, strict=True):
        assert_matches(name, found, wanted, tolerances)
    rgb, _, _, v_sigmas, v_colors = by_kernel(any_device, *given, v_rgb)
    for found, wanted in zip(run(np.tile(BACKGROUND, (37, 1))), (rgb, v_sigmas, v_colors), strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("count", [1, 7, 64])
def test_a_homogeneous_medium_has_its_closed_form(any_device, count):
    """Colour c (1 - exp(-sigma L)) + exp(-sigma L) background, however the length L is divided."""
    rng = np.random.default_rng(count)
    sigma, color = 1.7, np.array([0.9, 0.3, 0.1])
    parts = rng.dirichlet(np.ones(count)) * 2.5
    given = np.full(count, sigma), np.tile(color, (count, 1)), parts, np.array([0, count], np.uint32)
    through = np.exp(-sigma * 2.5)
    for run in (by_twin, partial(by_kernel, any_device)):
        rgb, _, behind = run(*given)
        # Float: 64 products, each rounded to 6e-8.
        rtol = 1e-13 if run is by_twin or any_device.real == np.float64 else 1e-5
        np.testing.assert_allclose(behind, [through], rtol=rtol)
        np.testing.assert_allclose(rgb, [color * (1 - through) + through * np.array(BACKGROUND)], rtol=rtol)


def test_a_slab_in_empty_space_has_its_closed_form(any_device):
    """Nothing before and behind one slab: its alpha is 1 - exp(-sigma d), wherever it is."""
    sigmas, colors = np.zeros(9), np.random.default_rng(0).uniform(size=(9, 3))
    sigmas[4] = 12
    first, deltas = np.array([0, 9], np.uint32), np.full(9, 0.125)
    alpha = 1 - np.exp(-12 * 0.125)
    expected = alpha * colors[4] + (1 - alpha) * np.array(BACKGROUND)
    for run in (by_twin, partial(by_kernel, any_device)):
        rtol = 1e-13 if run is by_twin or any_device.real == np.float64 else 1e-6
        np.testing.assert_allclose(run(sigmas, colors, deltas, first)[0][0], expected, rtol=rtol)


def test_nothing_is_seen_behind_an_opaque_sample(any_device):
    given = np.array([1e3, 1e3]), np.eye(3)[:2], np.ones(2), np.array([0, 2], np.uint32)
    rgb, transmittances, behind, v_sigmas, v_colors = by_kernel(any_device, *given, np.ones((1, 3)))
    np.testing.assert_array_equal(rgb, [[1, 0, 0]])
    np.testing.assert_array_equal(transmittances, [1, 0])
    assert behind == 0 and not v_sigmas.any() and not v_colors[1].any()


def test_gradients_by_central_differences(device64):
    sigmas, colors, deltas, first = samples(rays=9)
    v = np.random.default_rng(2).normal(size=(9, 3))
    *_, v_sigmas, v_colors = by_kernel(device64, sigmas, colors, deltas, first, v)
    gradcheck(
        lambda sigmas, colors: float((by_kernel(device64, sigmas, colors, deltas, first)[0] * v).sum()),
        {"sigmas": sigmas, "colors": colors},
        {"sigmas": v_sigmas, "colors": v_colors},
    )


def test_rays_and_splats_composite_the_same_image(any_device):
    """Splats of constant alpha over the image, with alpha = 1 - exp(-sigma delta), give the colour of each ray."""
    rng = np.random.default_rng(3)
    count, width, height = 12, 16, 16
    sigmas, deltas, colors = rng.uniform(1, 3, count), rng.uniform(0.05, 0.1, count), rng.uniform(size=(count, 3))
    alphas = 1 - np.exp(-sigmas * deltas)
    flat = Splats(
        means2d=np.full((count, 2), 8.0),
        conics=np.tile([1e-16, 0, 1e-16], (count, 1)),  # so wide that it has its opacity in each pixel
        depths=np.arange(1.0, count + 1),
        extents=np.full((count, 2), 32.0),
        opacities=alphas,
        colors=colors,
    )
    splats = Splats(*(any_device.upload(name, array) for name, array in flat._asdict().items()))
    bins = ops.bin_splats(any_device, splats, width, height, 16)
    image = ops.composite_fwd(any_device, splats, bins, np.array(BACKGROUND)).rgb.get()
    rays = width * height
    first = np.arange(0, count * rays + 1, count, dtype=np.uint32)
    given = np.tile(sigmas, rays), np.tile(colors, (rays, 1)), np.tile(deltas, rays), first
    rgb = by_kernel(any_device, *given)[0].reshape(height, width, 3)
    assert_matches("image", image, rgb.astype(np.float64), DOUBLE if any_device.real == np.float64 else FLOAT)
