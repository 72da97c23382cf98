"""The variant of the stage composite that sorts each pixel: twin, equation and central differences."""

from contextlib import nullcontext

import numpy as np
import pytest
from test_composite import (
    BACKGROUND,
    brute_force,
    clear_of_thresholds,
    handmade,
    make_splats,
    on_device,
    random_grads,
)
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.config import RenderConfig
from clsplat.constants import ALPHA_MAX, TRANSMITTANCE_MIN
from clsplat.device import Device
from clsplat.errors import DeviceError
from clsplat.ops import composite
from clsplat.render import render
from clsplat.stages import Image, SplatGrads, Splats
from clsplat.testing import assert_matches, gradcheck, synthetic_scene


def planes(splats, seed=0, tilt=0.02):
    """Disparities as steep as those of large discs: within a splat the order changes many times."""
    rng = np.random.default_rng(seed)
    shown = splats.extents[:, :1] > 0
    slopes = rng.normal(0, tilt, splats.means2d.shape)
    inverse = 1 / np.where(splats.depths > 0, splats.depths, 1)
    return np.where(shown, np.column_stack([inverse, slopes]), 0).astype(np.float32).astype(np.float64)


def forward(device, splats, bins, background, disparities):
    uploaded = device.upload("disparities", disparities)
    image = ops.composite_fwd(device, *on_device(device, splats, bins), background, disparities=uploaded)
    return Image(*(a.get() for a in image))


def backward(device, splats, bins, image, v_image, disparities):
    images = [Image(*(device.upload("image", a) for a in i)) for i in (image, v_image)]
    uploaded = device.upload("disparities", disparities)
    v = ops.composite_bwd(device, *on_device(device, splats, bins), *images, disparities=uploaded)
    return SplatGrads(*(a.get() for a in v))


def test_twin_matches_brute_force():
    splats, width, height = make_splats(80, 1, width=19, height=13)
    disparities = planes(splats)
    expected = brute_force(splats, width, height, BACKGROUND, disparities)
    for tile_size in (8, 19):
        bins = reference.bin_splats(splats, width, height, tile_size)
        image = reference.composite_fwd(splats, bins, BACKGROUND, disparities=disparities)
        assert_matches("image", image.rgb, expected.rgb, DOUBLE)
        assert_matches("alpha", image.alpha, expected.alpha, DOUBLE)
    by_centre = reference.composite_fwd(splats, bins, BACKGROUND)
    assert np.abs(by_centre.rgb - image.rgb).max() > 0.1, "the order must matter"


@pytest.mark.parametrize(("tile_size", "channels", "window"), [(16, 3, 1), (8, 4, 5), (16, 4, 32), (8, 3, 32)])
def test_double_matches_twin(device64, monkeypatch, tile_size, channels, window):
    """300 splats in one to four tiles: many rounds, windows that overflow, and pixels that stop early."""
    monkeypatch.setattr(composite, "WINDOW", window)
    splats, width, height = make_splats(300, 2, channels=channels)
    bins, disparities = reference.bin_splats(splats, width, height, tile_size), planes(splats)
    expected = reference.composite_fwd(splats, bins, BACKGROUND[:channels], disparities=disparities)
    image = forward(device64, splats, bins, BACKGROUND[:channels], disparities)
    assert_matches("image", image.rgb, expected.rgb, DOUBLE)
    assert_matches("alpha", image.alpha, expected.alpha, DOUBLE)

    v_image = random_grads(expected)
    v_expected = reference.composite_bwd(splats, bins, expected, v_image, disparities=disparities)
    v = backward(device64, splats, bins, expected, v_image, disparities)
    for name, array in v_expected._asdict().items():
        assert_matches(f"v_{name}", getattr(v, name), array, DOUBLE)


def test_float_matches_twin(device):
    """But where rounding decides whether a pair is seen, or which of two comes first."""
    splats, width, height = make_splats(300, 3, width=97, height=71, channels=3)
    bins, disparities = reference.bin_splats(splats, width, height, 16), planes(splats)
    expected = reference.composite_fwd(splats, bins, BACKGROUND[:3], disparities=disparities)
    image = forward(device, splats, bins, BACKGROUND[:3], disparities)
    error = np.abs(image.rgb - expected.rgb).max(axis=2)
    assert (error < 1e-5).mean() > 0.995, "float32: up to a hundred pairs per pixel"
    assert error.max() < 0.05, "one pair, or two neighbours whose order flips"
    band = error >= 1e-5
    v_image = random_grads(expected)
    v_image.rgb[band], v_image.alpha[band] = 0, 0
    v_expected = reference.composite_bwd(splats, bins, expected, v_image, disparities=disparities)
    v = backward(device, splats, bins, image, v_image, disparities)
    for name, array in v_expected._asdict().items():
        assert_matches(f"v_{name}", getattr(v, name), array, FLOAT)


@pytest.mark.parametrize("opacities", [(0.1, 0.7), (0.5, 0.9999)], ids=["faint", "saturated and stopping"])
def test_central_differences(device64, opacities):
    """By all that compositing reads; the order is held, since its derivative is 0 wherever it has one."""
    width, height = 23, 19

    def draw(rng):
        means2d = rng.uniform(0.2, 0.8, (12, 2)) * [width, height]
        return handmade(means2d, [[40, 8], [8, 30]], rng.uniform(*opacities, 12), rng.uniform(size=(12, 4)))

    def stop_distance(splats):
        """Smallest |ln(T/TRANSMITTANCE_MIN)| in the pixels' own order, which clear_of_thresholds does not know."""
        bins, transmittance = reference.bin_splats(splats, width, height, 16), np.empty((height, width))
        found = reference.composite.layers(splats, bins, planes(splats), transmittance)
        behind = [layer.before * (1 - np.minimum(layer.alpha, ALPHA_MAX)) for layer in found]
        return min(np.abs(np.log(b / TRANSMITTANCE_MIN)).min() for b in behind)

    streams = (np.random.default_rng(seed) for seed in range(100))
    scenes = (clear_of_thresholds(lambda rng, s=s: draw(s), width, height) for s in streams)
    splats = next(splats for splats in scenes if stop_distance(splats) > 1e-3)
    bins, disparities = reference.bin_splats(splats, width, height, 16), planes(splats)
    image = forward(device64, splats, bins, BACKGROUND, disparities)
    v_image = random_grads(image)

    def scalar(**moved):
        out = forward(device64, splats._replace(**moved), bins, BACKGROUND, disparities)
        return float(sum(((o - i) * v).sum() for o, i, v in zip(out, image, v_image, strict=True)))

    v = backward(device64, splats, bins, image, v_image, disparities)
    gradcheck(scalar, {name: getattr(splats, name) for name in SplatGrads._fields}, v._asdict())


def test_two_discs_that_cross(any_device):
    """Each is in front on one side of the line where they meet, whichever centre is nearer."""
    splats = handmade([(8, 8), (8, 8)], np.eye(2) * 400, [0.9, 0.9], [[1, 0, 0], [0, 1, 0]])
    disparities = np.array([[1.0, 0.01, 0], [0.999, -0.01, 0]])
    bins = reference.bin_splats(splats, 16, 16, 16)
    image = forward(any_device, splats, bins, (0.0, 0.0, 0.0), disparities).rgb
    red = image[:, :, 0] > image[:, :, 1]
    np.testing.assert_array_equal(red, np.tile(np.arange(16) >= 8, (16, 1)))


def test_ties_go_by_the_list(any_device, monkeypatch):
    """Also where the window ends between them."""
    monkeypatch.setattr(composite, "WINDOW", 1)
    colors = np.eye(3)
    splats = handmade([(8, 8)] * 3, np.eye(2) * 400, [0.5] * 3, colors)._replace(depths=np.ones(3))
    bins = reference.bin_splats(splats, 16, 16, 16)
    image = forward(any_device, splats, bins, (0.0, 0.0, 0.0), np.tile([1.0, 0, 0], (3, 1))).rgb
    assert (image[..., 0] > image[..., 1]).all() and (image[..., 1] > image[..., 2]).all()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4099, 3), (3, 1025), (17, 16)])
def test_image_sizes(device64, width, height):
    rng = np.random.default_rng(0)
    centres = rng.uniform(0, 1, (60, 2)) * [width, height]
    splats = handmade(centres, [[9, 2], [2, 4]], rng.uniform(0.2, 0.9, 60), rng.uniform(size=(60, 4)))
    bins, disparities = reference.bin_splats(splats, width, height, 16), planes(splats)
    expected = reference.composite_fwd(splats, bins, BACKGROUND, disparities=disparities)
    image = forward(device64, splats, bins, BACKGROUND, disparities)
    assert_matches("image", image.rgb, expected.rgb, DOUBLE)
    v_image = random_grads(expected)
    v_expected = reference.composite_bwd(splats, bins, expected, v_image, disparities=disparities)
    v = backward(device64, splats, bins, expected, v_image, disparities)
    for name, array in v_expected._asdict().items():
        assert_matches(f"v_{name}", getattr(v, name), array, DOUBLE)


def test_nothing_visible(any_device):
    splats = Splats(*(np.zeros(s) for s in ((5, 2), (5, 3), (5,), (5, 2), (5,), (5, 4))))
    uploaded = Splats(*(any_device.upload("splats", a) for a in splats))
    bins = ops.bin_splats(any_device, uploaded, 20, 10, 16)
    none = any_device.upload("disparities", np.zeros((5, 3)))
    image = ops.composite_fwd(any_device, uploaded, bins, BACKGROUND, disparities=none)
    np.testing.assert_array_equal(image.rgb.get(), np.tile(np.array(BACKGROUND, any_device.real), (10, 20, 1)))
    v = ops.composite_bwd(any_device, uploaded, bins, image, image, disparities=none)
    assert all((array.get() == 0).all() for array in v)


def test_same_bits_twice_and_for_every_tiling(device):
    """Centres on a grid of 1/256 px make every distance to a pixel exact, whichever tile it is counted from."""
    splats, width, height = make_splats(200, 6)
    splats = splats._replace(means2d=np.round(splats.means2d * 256) / 256)
    disparities = planes(splats)
    bins = {t: reference.bin_splats(splats, width, height, t) for t in (8, 16, 32)}
    images = [forward(device, splats, bins[t], BACKGROUND, disparities) for t in (16, 16, 8, 32)]
    for image in images[1:]:
        np.testing.assert_array_equal(image.rgb, images[0].rgb)
        np.testing.assert_array_equal(image.alpha, images[0].alpha)
    v_image = random_grads(images[0])
    v = [backward(device, splats, bins[16], images[0], v_image, disparities) for _ in range(2)]
    for name in SplatGrads._fields:
        np.testing.assert_array_equal(getattr(v[0], name), getattr(v[1], name), err_msg=name)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_render_sorts_pixels(device64, mode):
    """From the Gaussians to their gradients, the twin's and the device's."""
    gaussians, camera = synthetic_scene(150, 7)
    config = RenderConfig(mode=mode, sort="pixel", tile_size=8)
    expected, found = (render(gaussians, camera, config, d, depth=True) for d in ("reference", device64))
    by_centre = render(gaussians, camera, RenderConfig(mode=mode), "reference")
    assert np.abs(expected.rgb - by_centre.rgb).max() > 0.05
    assert_matches("rgb", found.rgb, expected.rgb, DOUBLE)
    v_rgb, v_depth = np.random.default_rng(0).normal(size=(2, *expected.rgb.shape))
    expected, found = (r.backward(v_rgb, v_depth=v_depth[:, :, 0]).gaussians for r in (expected, found))
    for name, array in expected.arrays().items():
        assert_matches(f"v_{name}", found.arrays()[name], array, DOUBLE)


def test_a_gpu_without_memory_for_the_windows_is_refused():
    """Its driver reserves the private memory of all work-items that it keeps at a time, or fails without a reason."""
    for is_cpu, limit, refused in ((False, 30 << 20, True), (False, None, False), (True, 30 << 20, False)):
        device = Device(memory_limit=limit)
        device.is_cpu = is_cpu  # shadows the cached property
        gaussians, camera = synthetic_scene(5, width=16, height=16)
        # A pixel has 32 splats of three numbers in its window, three colours and four states; a unit 2048 items.
        reserved = 8**2 * (3 * 32 + 3 + 4) * 4 * 2048 * device.cl_device.max_compute_units / 2**30
        message = rf"--sort pixel: .* would reserve {reserved:.1f} GiB for .*, but 0\.0 GiB are left"
        with pytest.raises(DeviceError, match=message) if refused else nullcontext():
            render(gaussians, camera, RenderConfig(sort="pixel"), device)
