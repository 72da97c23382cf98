"""Stage composite: both variants against the twin, against central differences, on degenerate input."""

import numpy as np
import pytest
from device_opening import open_device
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.constants import ALPHA_MAX, ALPHA_MIN, EXTENT_SLACK, TRANSMITTANCE_MIN
from clsplat.stages import Bins, Image, SplatGrads, Splats
from clsplat.testing import ambiguous_pixels, assert_matches, gradcheck, synthetic_scene

TILE_SIZES = pytest.mark.parametrize("tile_size", [8, 16, 32])
CHANNELS = pytest.mark.parametrize("channels", [3, 4])
BACKGROUND = (0.3, 0.6, 0.1, 0.0)


def make_splats(n, seed=0, *, width=37, height=29, channels=4, margin=0.0):
    """Visible splats whose values are float32 numbers, and the image's size."""
    gaussians, camera = synthetic_scene(n, seed, width=width, height=height, margin=margin)
    splats = reference.project_fwd(gaussians, camera, 3, channels=channels)
    return rounded(splats), width, height


def rounded(splats):
    return Splats(*(a.astype(np.float32).astype(np.float64) for a in splats))


def with_extents(splats):
    """The splats with the extents that belong to their conics and opacities."""
    a, b, c = splats.conics.T
    r2 = 2 * (np.log(splats.opacities / ALPHA_MIN) + EXTENT_SLACK)
    variances = np.stack([c, a], axis=1) / (a * c - b * b)[:, None]
    return splats._replace(extents=np.sqrt(r2[:, None] * variances))


def handmade(means2d, cov, opacities, colors):
    """Splats of one covariance, front to back."""
    n = len(means2d)
    conics = np.tile(np.linalg.inv(cov)[[0, 0, 1], [0, 1, 1]], (n, 1))
    fields = (means2d, conics, 1 + np.arange(n), np.zeros((n, 2)), opacities, colors)
    return with_extents(Splats(*(np.array(a, dtype=np.float64) for a in fields)))


def on_device(device, splats, bins):
    arrays = [device.upload("bins", a, np.uint32) for a in bins[:4]]
    return Splats(*(device.upload("splats", a) for a in splats)), Bins(*arrays, *bins[4:])


def forward(device, compositor, splats, bins, background):
    image = ops.composite_fwd(device, *on_device(device, splats, bins), background, compositor=compositor)
    return Image(*(a.get() for a in image))


def backward(device, compositor, splats, bins, image, v_image):
    images = [Image(*(device.upload("image", a) for a in i)) for i in (image, v_image)]
    v = ops.composite_bwd(device, *on_device(device, splats, bins), *images, compositor=compositor)
    return SplatGrads(*(a.get() for a in v))


def random_grads(image, seed=0):
    rng = np.random.default_rng(seed)
    return Image(rng.normal(size=image.rgb.shape), rng.normal(size=image.alpha.shape))


def brute_force(splats, width, height, background, disparities=None):
    """Equation 3, pixel by pixel as it is written: no tiles, no boxes, no arrays of pixels.

    In the order of the centres' depths, or, given `disparities`, of what these are in the pixel.
    """
    image, alphas = np.zeros((height, width, len(background))), np.zeros((height, width))
    shown = [g for g in np.argsort(splats.depths, kind="stable") if splats.extents[g, 0] > 0]
    for i in range(height):
        for j in range(width):
            transmittance = 1.0
            offsets = np.array([j + 0.5, i + 0.5]) - splats.means2d
            order = shown
            if disparities is not None:
                here = disparities[:, 0] + (disparities[:, 1:] * offsets).sum(axis=1)
                order = sorted(shown, key=lambda g: -here[g])
            for g in order:
                a, b, c = splats.conics[g]
                d = offsets[g]
                alpha = min(ALPHA_MAX, splats.opacities[g] * np.exp(-0.5 * d @ [[a, b], [b, c]] @ d))
                if alpha < ALPHA_MIN:
                    continue
                if transmittance * (1 - alpha) <= TRANSMITTANCE_MIN:
                    break
                image[i, j] += splats.colors[g] * alpha * transmittance
                transmittance *= 1 - alpha
            image[i, j] += transmittance * np.array(background)
            alphas[i, j] = 1 - transmittance
    return Image(image, alphas)


def test_twin_matches_brute_force():
    splats, width, height = make_splats(60, 1, width=19, height=13)
    expected = brute_force(splats, width, height, BACKGROUND)
    assert expected.alpha.max() > 0.9
    for tile_size in (8, 16, 19):
        image = reference.composite_fwd(splats, reference.bin_splats(splats, width, height, tile_size), BACKGROUND)
        assert_matches("image", image.rgb, expected.rgb, DOUBLE)
        assert_matches("alpha", image.alpha, expected.alpha, DOUBLE)


@TILE_SIZES
@CHANNELS
def test_double_matches_twin(device64, compositor, tile_size, channels):
    """300 splats in one to four tiles: more than a batch of the GPU variant, and pixels that stop early."""
    splats, width, height = make_splats(300, 2, channels=channels)
    assert not ambiguous_pixels(splats, width, height, margin=1e-9).any()
    bins = reference.bin_splats(splats, width, height, tile_size)
    assert np.diff(bins.tile_ranges).max() > 64
    expected = reference.composite_fwd(splats, bins, BACKGROUND[:channels])
    image = forward(device64, compositor, splats, bins, BACKGROUND[:channels])
    assert_matches("image", image.rgb, expected.rgb, DOUBLE)
    assert_matches("alpha", image.alpha, expected.alpha, DOUBLE)

    v_image = random_grads(expected)
    v_expected = reference.composite_bwd(splats, bins, expected, v_image)
    v = backward(device64, compositor, splats, bins, expected, v_image)
    for name, array in v_expected._asdict().items():
        assert_matches(f"v_{name}", getattr(v, name), array, DOUBLE)


@TILE_SIZES
@pytest.mark.parametrize("lanes", [8, 16])
def test_blocks_of_both_widths_match_twin(lanes, tile_size):
    """The device's registers choose one; each must be right on all."""
    device = open_device(np.float64)
    device.vector_width = lanes  # shadows the cached property
    splats, width, height = make_splats(300, 2, channels=3)
    bins = reference.bin_splats(splats, width, height, tile_size)
    expected = reference.composite_fwd(splats, bins, BACKGROUND[:3])
    image = forward(device, "cpu", splats, bins, BACKGROUND[:3])
    assert_matches("image", image.rgb, expected.rgb, DOUBLE)
    v_image = random_grads(expected)
    v_expected = reference.composite_bwd(splats, bins, expected, v_image)
    v = backward(device, "cpu", splats, bins, expected, v_image)
    for name, array in v_expected._asdict().items():
        assert_matches(f"v_{name}", getattr(v, name), array, DOUBLE)


@pytest.mark.parametrize(("tile_size", "channels"), [(16, 3), (8, 4)])
def test_float_matches_twin(device, compositor, tile_size, channels):
    splats, width, height = make_splats(400, 3, width=97, height=71, channels=channels)
    bins = reference.bin_splats(splats, width, height, tile_size)
    background = BACKGROUND[:channels]
    expected = reference.composite_fwd(splats, bins, background)
    image = forward(device, compositor, splats, bins, background)
    band = ambiguous_pixels(splats, width, height, margin=1e-3)
    assert 0 < band.mean() < 0.25, "a band this wide proves nothing"
    assert_matches("image", image.rgb, expected.rgb, FLOAT, where=~band)
    assert_matches("alpha", image.alpha, expected.alpha, FLOAT, where=~band)

    # In the band one pair may flip: it moves a pixel by ALPHA_MIN or so of the splat's colour, either way.
    flips = image.alpha[band] - expected.alpha[band]
    assert np.abs(flips).max() < 1.1 * ALPHA_MIN
    assert (np.abs(flips) > 1e-4).mean() < 0.01, "far fewer than the band's pixels flip"
    assert abs(flips.sum()) < 4 * np.sqrt((flips**2).sum()) + 1e-5, "flips go one way"

    # Pixels of the band pass no gradient, so that every other pair decides as the twin does.
    v_image = random_grads(expected)
    v_image.rgb[band], v_image.alpha[band] = 0, 0
    v_expected = reference.composite_bwd(splats, bins, expected, v_image)
    v = backward(device, compositor, splats, bins, image, v_image)
    for name, array in v_expected._asdict().items():
        assert_matches(f"v_{name}", getattr(v, name), array, FLOAT)


def check_gradients(device, compositor, splats, width, height, tile_size=16):
    """Central differences by everything that compositing reads, with gradients of the image and of alpha."""
    channels = splats.colors.shape[1]
    assert not ambiguous_pixels(splats, width, height, margin=1e-3).any()
    bins = reference.bin_splats(splats, width, height, tile_size)
    image = forward(device, compositor, splats, bins, BACKGROUND[:channels])
    v_image = random_grads(image)

    def scalar(**moved):
        out = forward(device, compositor, splats._replace(**moved), bins, BACKGROUND[:channels])
        return float(sum(((o - i) * v).sum() for o, i, v in zip(out, image, v_image, strict=True)))

    v = backward(device, compositor, splats, bins, image, v_image)
    gradcheck(scalar, {name: getattr(splats, name) for name in SplatGrads._fields}, v._asdict())
    v_twin = reference.composite_bwd(splats, bins, image, v_image)
    for name, array in v_twin._asdict().items():
        assert_matches(f"v_{name}", getattr(v, name), array, DOUBLE)
    return image, v


@pytest.mark.parametrize(("tile_size", "channels"), [(16, 3), (8, 4)])
def test_central_differences(device64, compositor, tile_size, channels):
    splats, width, height = make_splats(90, 4, channels=channels, margin=2e-3)
    image, _ = check_gradients(device64, compositor, splats, width, height, tile_size)
    assert image.alpha.max() > 0.95


def clear_of_thresholds(draw, width, height):
    """The first of the random splats that `draw` (seed) yields which keeps away from every threshold."""
    for seed in range(1000):
        splats = draw(np.random.default_rng(seed))
        if not ambiguous_pixels(splats, width, height, margin=1e-3).any():
            return splats
    raise AssertionError("no seed keeps away from every threshold")


def test_central_differences_where_alpha_saturates(device64, compositor):
    """Splats with opacity exp(-sigma) > ALPHA_MAX around their centres: the clamp passes no gradient."""
    width, height, opacities = 23, 19, [0.9999, 0.8, 1.0, 0.995]

    def draw(rng):
        means2d = rng.uniform(0.2, 0.8, (4, 2)) * [width, height]
        return handmade(means2d, [[40, 8], [8, 30]], opacities, rng.uniform(size=(4, 4)))

    splats = clear_of_thresholds(draw, width, height)
    j, i = np.floor(splats.means2d[2]).astype(int)
    d = np.array([j, i]) + 0.5 - splats.means2d[2]
    a, b, c = splats.conics[2]
    assert np.exp(-0.5 * d @ [[a, b], [b, c]] @ d) > ALPHA_MAX, "no pixel is saturated"
    check_gradients(device64, compositor, splats, width, height)


def test_central_differences_where_pixels_stop(device64, compositor):
    width, height = 23, 19

    def draw(rng):
        means2d, opacities = rng.uniform(0.3, 0.7, (31, 2)) * [width, height], rng.uniform(0.6, 0.95, 31)
        means2d[30] = width / 2, height / 2
        splats = handmade(means2d, [[40, 4], [4, 30]], opacities, rng.uniform(size=(31, 4)))
        splats.conics[30] = 1, 0, 1
        return with_extents(splats)

    splats = clear_of_thresholds(draw, width, height)
    image, v = check_gradients(device64, compositor, splats, width, height)
    assert (image.alpha > 1 - 2 * TRANSMITTANCE_MIN).any()
    assert (v.colors[30] == 0).all(), "the last splat lies wholly behind pixels that stopped"
