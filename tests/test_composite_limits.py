"""Stage composite: stop, clamp, images of all sizes, and degenerate splats."""

import numpy as np
import pytest
from test_composite import (
    BACKGROUND,
    backward,
    forward,
    handmade,
    make_splats,
    random_grads,
)
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.constants import ALPHA_MAX, ALPHA_MIN
from clsplat.errors import InputError
from clsplat.stages import Bins, Image, SplatGrads, Splats
from clsplat.testing import assert_matches


def test_stop_and_skip_in_numbers(any_device, compositor):
    """By hand: 0.95 leaves T = 1.25e-4 after three splats; the next would undercut 1e-4 and ends the pixel.

    The splat between them is centred 40 px away, where its alpha is 3e-4.
    """
    splats = handmade(
        [(0.5, 0.5), (0.5, 0.5), (40.5, 0.5), (0.5, 0.5), (0.5, 0.5), (0.5, 0.5)],
        np.eye(2) * 100,
        [0.95, 0.95, 0.95, 0.95, 0.95, 0.01],
        [[1, 0, 0], [0, 1, 0], [9, 9, 9], [0, 0, 1], [9, 9, 9], [9, 9, 9]],
    )
    order = np.arange(6)
    bins = Bins(order, np.array([[0, 6]]), np.arange(7), order, 16, 1, 1)
    image = forward(any_device, compositor, splats, bins, (0.0, 0.0, 0.0))
    weights = 0.95 * np.array([1, 0.05, 0.0025])
    np.testing.assert_allclose(image.rgb[0, 0], weights, rtol=1e-5)
    np.testing.assert_allclose(image.alpha, 1 - 1.25e-4, rtol=1e-6)
    ones = Image(np.ones((1, 1, 3)), np.zeros((1, 1)))
    v = backward(any_device, compositor, splats, bins, image, ones)
    np.testing.assert_allclose(v.colors[:, 0], [*weights[:2], 0, weights[2], 0, 0], rtol=1e-5)
    assert (v.opacities[[2, 4, 5]] == 0).all() and (v.means2d[[2, 4, 5]] == 0).all()


def test_alpha_is_clamped(any_device, compositor):
    splats = handmade([(0.5, 0.5)], np.eye(2), [1.0], [[1, 1, 1]])
    one = np.zeros(1)
    bins = Bins(one, np.array([[0, 1]]), np.arange(2), one, 16, 1, 1)
    image = forward(any_device, compositor, splats, bins, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(image.alpha, ALPHA_MAX, rtol=1e-6)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4099, 3), (3, 1025), (17, 16)])
def test_image_sizes(device64, compositor, width, height):
    rng = np.random.default_rng(0)
    n = 60
    splats = handmade(
        rng.uniform(0, 1, (n, 2)) * [width, height],
        [[9, 2], [2, 4]],
        rng.uniform(0.2, 0.9, n),
        rng.uniform(size=(n, 4)),
    )
    bins = reference.bin_splats(splats, width, height, 16)
    expected = reference.composite_fwd(splats, bins, BACKGROUND)
    image = forward(device64, compositor, splats, bins, BACKGROUND)
    assert_matches("image", image.rgb, expected.rgb, DOUBLE)
    v_image = random_grads(expected)
    v_expected = reference.composite_bwd(splats, bins, expected, v_image)
    v = backward(device64, compositor, splats, bins, expected, v_image)
    for name, array in v_expected._asdict().items():
        assert_matches(f"v_{name}", getattr(v, name), array, DOUBLE)


def test_nothing_visible(any_device, compositor):
    splats = Splats(*(np.zeros(s) for s in ((5, 2), (5, 3), (5,), (5, 2), (5,), (5, 4))))
    uploaded = Splats(*(any_device.upload("splats", a) for a in splats))
    bins = ops.bin_splats(any_device, uploaded, 20, 10, 16)
    image = ops.composite_fwd(any_device, uploaded, bins, BACKGROUND, compositor=compositor)
    np.testing.assert_array_equal(image.rgb.get(), np.tile(np.array(BACKGROUND, any_device.real), (10, 20, 1)))
    np.testing.assert_array_equal(image.alpha.get(), np.zeros((10, 20)))
    v = ops.composite_bwd(any_device, uploaded, bins, image, image, compositor=compositor)
    for name, array in v._asdict().items():
        assert (array.get() == 0).all(), name


def test_an_indefinite_conic_is_taken_for_a_needle(any_device, compositor):
    """Rounding can make a needle's conic indefinite: exp(-sigma) would grow without bound along its axis."""
    splats = handmade([(8.0, 8.0)], np.eye(2), [0.5], [[1, 1, 1]])._replace(conics=np.array([[1.0, 1.5, 1.0]]))
    one = np.zeros(1)
    bins = Bins(one, np.array([[0, 1]]), np.arange(2), one, 16, 16, 16)
    image = forward(any_device, compositor, splats, bins, (0.0, 0.0, 0.0))
    y, x = np.indices((16, 16)) + 0.5 - 8
    expected = 0.5 * np.exp(-0.5 * (x + 1.5 * y) ** 2)
    expected[expected < ALPHA_MIN] = 0
    inside = np.abs(y) < splats.extents[0, 1] - 1  # beyond it, blocks of pixels may be left out
    np.testing.assert_allclose(image.alpha[inside], expected[inside], atol=1e-5)  # the least conic is EPSILON
    assert image.alpha.max() <= 0.5
    v = backward(any_device, compositor, splats, bins, image, random_grads(image))
    assert all(np.isfinite(a).all() and a.any() for a in v)


def test_a_needle_is_as_long_as_its_conic_says(any_device, compositor):
    """The determinant of its conic is 1/130000 of the products that it is the difference of."""
    along, across = np.array([np.cos(0.7), np.sin(0.7)]), np.array([-np.sin(0.7), np.cos(0.7)])
    cov = 400**2 * np.outer(along, along) + 0.55**2 * np.outer(across, across)
    splats = handmade([(256.5, 256.5)], cov, [0.9], [[1, 1, 1]])
    splats = splats._replace(conics=splats.conics.astype(np.float32).astype(np.float64))
    image = forward(any_device, compositor, splats, reference.bin_splats(splats, 512, 512, 16), (0.0, 0.0, 0.0))
    y, x = np.indices((512, 512)) - 256.0
    a, b, c = splats.conics[0]
    expected = 0.9 * np.exp(-0.5 * (a * x * x + c * y * y) - b * x * y)
    drawn = expected > 1.01 * ALPHA_MIN
    assert drawn.sum() > 1000
    # Rounding leaves 1e-5; a determinant that cancels is off by 4e-4.
    np.testing.assert_allclose(image.alpha[drawn], expected[drawn], atol=5e-5)


def test_same_bits_twice_and_the_same_image_for_every_tiling(device, compositor):
    splats, width, height = make_splats(200, 6)
    bins = {t: reference.bin_splats(splats, width, height, t) for t in (8, 16, 32)}
    images = [forward(device, compositor, splats, bins[t], BACKGROUND) for t in (16, 16, 8, 32)]
    np.testing.assert_array_equal(images[1].rgb, images[0].rgb)
    np.testing.assert_array_equal(images[1].alpha, images[0].alpha)
    for image in images[2:]:
        # Distances are counted from a tile's corner, so they round differently.
        assert_matches("image", image.rgb, images[0].rgb, FLOAT)
        assert_matches("alpha", image.alpha, images[0].alpha, FLOAT)
    v_image = random_grads(images[0])
    v = [backward(device, compositor, splats, bins[16], images[0], v_image) for _ in range(2)]
    for name in SplatGrads._fields:
        np.testing.assert_array_equal(getattr(v[0], name), getattr(v[1], name), err_msg=name)


def test_what_overflows_has_no_gradient(any_device, compositor):
    """Found by fuzzing: the gradient of one centre was NaN, and so would have been the statistics of densification.

    Two splats beside each other: the brightness of one overflows.
    """
    bright = 3e38 if any_device.real == np.float32 else 1e308
    colors = np.array([[bright] * 3, [0.5] * 3])
    splats = handmade([(8, 8), (28, 8)], 2 * np.eye(2), [0.5, 0.5], colors)
    width, height = 36, 16
    bins = reference.bin_splats(splats, width, height, 16)
    v_image = Image(np.full((height, width, 3), 100.0), np.zeros((height, width)))
    image = forward(any_device, compositor, splats, bins, (0.0, 0.0, 0.0))
    assert np.isfinite(image.rgb).all()
    with np.errstate(all="ignore"):
        twin = reference.composite_bwd(splats, bins, image, v_image)
    for first, second in backward(any_device, compositor, splats, bins, image, v_image):
        assert (first == 0).all() and np.isfinite(second).all()
    assert all(np.isfinite(array).all() for array in twin) and twin.colors[1].min() > 0


def test_lists_without_slots_have_no_gradients(device):
    splats, width, height = make_splats(3)
    bins = reference.bin_splats(splats, width, height, 16, gradients=False)
    image = Image(np.zeros((height, width, 4)), np.zeros((height, width)))
    with pytest.raises(InputError, match=r"^bins: expected lists made with gradients=True"):
        ops.composite_bwd(device, splats, bins, image, image)
