"""Stage removal: against rendering anew without each splat, the kernel against the twin, pixels that stop early."""

from functools import cache

import numpy as np
import pytest
from device_opening import open_device
from test_composite import BACKGROUND, handmade, make_splats, on_device
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from clsplat.errors import InputError
from clsplat.stages import Bins, Removal, Splats
from clsplat.testing import ambiguous_pixels, assert_matches


@pytest.fixture(params=["cpu", "gpu"])
def variants(request):
    """Kernel variant; each runs on every device."""
    return request.param


@pytest.fixture
def each_device(any_device, variants):
    """The device in both precisions, with the kernels for CPUs and for GPUs."""
    return configured(any_device.real, variants)


@pytest.fixture
def each_device64(device64, variants):
    """The device in double precision, with the kernels for CPUs and for GPUs."""
    return configured(device64.real, variants)


@cache
def configured(real, variants):
    device = open_device(real)
    device.is_cpu = variants == "cpu"  # shadows the cached property
    return device


NEVER_STOPS = 1e-3  # well above TRANSMITTANCE_MIN


def target_and_mask(shape, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(size=shape), rng.random(shape[:2]) < 0.7


def without(splats, g):
    """The splats with one of them invisible."""
    extents = splats.extents.copy()
    extents[g] = 0
    return splats._replace(extents=extents)


def image_of(splats, width, height, background):
    bins = reference.bin_splats(splats, width, height, max(width, height))
    return reference.composite_fwd(splats, bins, background)


def squared_error(image, target, mask):
    return float(((image - target) ** 2)[mask].sum())


def by_kernel(device, splats, bins, *args):
    return ops.removal(device, *on_device(device, splats, bins), *args)


def faint(n, seed, width, height):
    """Splats so faint that no pixel stops, with or without one of them."""
    splats, width, height = make_splats(n, seed, width=width, height=height)
    splats = splats._replace(opacities=splats.opacities * 0.4)
    assert image_of(splats, width, height, BACKGROUND).alpha.max() < 1 - NEVER_STOPS
    return splats


def test_is_what_rendering_without_the_splat_shows(each_device):
    """Exactly: the error without each splat less that with all, and with another colour, where pixels count."""
    width, height = 23, 17
    splats = faint(40, 1, width, height)
    bins = reference.bin_splats(splats, width, height, 8)
    image = image_of(splats, width, height, BACKGROUND).rgb
    target, mask = target_and_mask(image.shape)
    args = splats, bins, BACKGROUND, image - target, mask
    before = squared_error(image, target, mask)
    images = [image_of(without(splats, g), width, height, BACKGROUND).rgb for g in range(len(splats.depths))]
    removed = [squared_error(other, target, mask) - before for other in images]
    changed = [squared_error(other, image, mask) for other in images]
    assert min(removed) < 0 < max(removed), "removal makes it worse and better"
    exact = each_device.real == np.float64
    table, tolerance = (DOUBLE, 1e-10) if exact else (FLOAT, 1e-4)
    for found in (reference.removal(*args), by_kernel(each_device, *args)):
        assert_matches("errors", found.errors, np.array(removed), table)
        assert_matches("differences", found.differences, np.array(changed), table)

        d = np.array([0.3, -0.2, 0.5, 1.0])
        for g in (0, 7, 31):
            colors = splats.colors.copy()
            colors[g] += d
            recoloured = image_of(splats._replace(colors=colors), width, height, BACKGROUND).rgb
            expected = squared_error(recoloured, target, mask) - before
            assert found.squares[g] * d @ d + 2 * found.pulls[g] @ d == pytest.approx(expected, rel=tolerance)

        error = ((image - target) ** 2 * mask[:, :, None]).sum(axis=2)
        alpha = image_of(splats, width, height, BACKGROUND).alpha
        assert found.shares.sum() == pytest.approx((alpha * error).sum(), rel=tolerance)

    everywhere = reference.removal(splats, bins, BACKGROUND)
    alpha = image_of(splats, width, height, BACKGROUND).alpha
    assert everywhere.weights.sum() == pytest.approx(alpha.sum(), rel=1e-12)
    assert (everywhere.errors == everywhere.differences).all() and (everywhere.pulls == 0).all()


@pytest.mark.parametrize("tile_size", [8, 16, 32])
@pytest.mark.parametrize("channels", [3, 4])
def test_double_matches_twin(each_device64, tile_size, channels):
    """300 splats in one to four tiles: lists of several batches, pixels that stop and that do not count."""
    splats, width, height = make_splats(300, 2, channels=channels)
    bins = reference.bin_splats(splats, width, height, tile_size)
    image = reference.composite_fwd(splats, bins, BACKGROUND[:channels])
    assert (image.alpha > 1 - 2 * TRANSMITTANCE_MIN).any() and np.diff(bins.tile_ranges).max() > 64
    target, mask = target_and_mask(image.rgb.shape)
    args = splats, bins, BACKGROUND[:channels], image.rgb - target, mask
    expected, found = reference.removal(*args), by_kernel(each_device64, *args)
    for name in Removal._fields:
        assert_matches(name, getattr(found, name), getattr(expected, name), DOUBLE)


@pytest.mark.parametrize("as_variants", ["cpu", "gpu"])
def test_float_matches_twin(as_variants):
    device = configured(np.float32, as_variants)
    splats, width, height = make_splats(400, 3, width=97, height=71, channels=3)
    bins = reference.bin_splats(splats, width, height, 16)
    image = reference.composite_fwd(splats, bins, BACKGROUND[:3])
    # Pixels in which rounding decides whether a pair is drawn do not count.
    band = ambiguous_pixels(splats, width, height, margin=1e-3)
    assert 0 < band.mean() < 0.25
    target, _ = target_and_mask(image.rgb.shape)
    args = splats, bins, BACKGROUND[:3], image.rgb - target, ~band
    expected, found = reference.removal(*args), by_kernel(device, *args)
    for name in Removal._fields:
        assert_matches(name, getattr(found, name), getattr(expected, name), FLOAT)
    again = by_kernel(device, *args)
    for name in Removal._fields:
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))


def test_an_opaque_splat_before_another_in_numbers(each_device):
    """By hand: behind 0.99 of red the pixel stops at the second splat, which without the red one would be seen."""
    colors = np.eye(4)[[0, 1, 2]][:, :3]
    splats = handmade([(0.5, 0.5)] * 3, np.eye(2), [1.0, 1.0, 0.5], colors)
    order = np.arange(3)
    bins = Bins(order, np.array([[0, 3]]), np.arange(4), order, 16, 1, 1)
    found = by_kernel(each_device, splats, bins, np.zeros(3))
    # Seen in front of what lies behind: red 0.99, green 0.0099; without red green 0.99, blue 0.005.
    less = np.array([0.99, 0.0099 - 0.99, 0.00005 - 0.005])
    assert found.errors[0] == pytest.approx(less @ less, rel=1e-5)


def test_pixels_that_stop_are_wrong_by_no_more_than_the_stop_hides():
    """A pixel stops at a transmittance of up to TRANSMITTANCE_MIN/(1 - ALPHA_MAX) = 0.01, which stands for what is
    not drawn: with the splat and without it. The rest is between the formula's own stop and nothing."""
    width, height = 21, 15
    rng = np.random.default_rng(0)
    n = 60
    means2d, opacities = rng.uniform(0, 1, (n, 2)) * [width, height], rng.uniform(0.7, 1.0, n)
    splats = handmade(means2d, [[40, 8], [8, 30]], opacities, rng.uniform(size=(n, 3)))
    background = np.zeros(3)
    image = image_of(splats, width, height, background)
    assert (image.alpha > 0.99).mean() > 0.9
    hidden = TRANSMITTANCE_MIN / (1 - ALPHA_MAX)
    errors = []
    for g in range(n):
        target = image_of(without(splats, g), width, height, background).rgb
        expected = ((image.rgb - target) ** 2).sum()
        bins = reference.bin_splats(splats, width, height, max(width, height))
        price = reference.removal(splats, bins, background).errors[g]
        # |D'|^2 - |D|^2 <= |D' - D| (2 |D| + |D' - D|), pixel by pixel; both stops may err, and the formula's own.
        slack = 3 * hidden
        bound = (slack * (2 * np.abs(image.rgb - target) + slack)).sum()
        assert abs(price - expected) <= bound
        errors.append([price, expected])
    price, expected = np.array(errors).T
    shown = expected > 1e-3 * expected.max()
    assert shown.sum() > 10
    assert np.abs(price[shown] / expected[shown] - 1).max() < 0.01, "0.02 with the stop of the image"


def test_nothing_visible(each_device):
    splats = Splats(*(np.zeros(s) for s in ((5, 2), (5, 3), (5,), (5, 2), (5,), (5, 3))))
    uploaded = Splats(*(each_device.upload("splats", a) for a in splats))
    found = ops.removal(each_device, uploaded, ops.bin_splats(each_device, uploaded, 20, 10, 16), np.ones(3))
    for name, array in found._asdict().items():
        assert (array == 0).all(), name


def test_what_is_too_faint_to_be_drawn_costs_nothing(each_device):
    splats = handmade([(8.0, 8.0)], np.eye(2) * 9, [0.5], [[1, 1, 1]])
    splats = splats._replace(opacities=np.array([0.9 * ALPHA_MIN]))
    one = np.zeros(1)
    bins = Bins(one, np.array([[0, 1]]), np.arange(2), one, 16, 16, 16)
    assert by_kernel(each_device, splats, bins, np.zeros(3)).errors[0] == 0


def test_splats_behind_a_finished_tile(each_device):
    """Five splats finish the only pixel; the list goes on for batches, whose records nobody else writes."""
    n = 80
    rng = np.random.default_rng(0)
    splats = handmade(np.full((n, 2), 0.5), np.eye(2), np.full(n, 0.95), rng.uniform(size=(n, 3)))
    order = np.arange(n)
    bins = Bins(order, np.array([[0, n]]), np.arange(n + 1), order, 16, 1, 1)
    each_device.upload("prices per intersection", np.full((n, 7), np.nan))  # what the next of this name will hold
    expected = reference.removal(splats, bins, (50.0, 20.0, 30.0))
    found = by_kernel(each_device, splats, bins, (50.0, 20.0, 30.0))
    assert (found.errors[4:] == 0).all() and (found.weights[4:] == 0).all() and found.weights[3] > 0
    table = DOUBLE if each_device.real == np.float64 else FLOAT
    assert_matches("errors", found.errors, expected.errors, table)


def test_lists_without_slots_are_refused(device):
    splats, width, height = make_splats(5)
    uploaded = Splats(*(device.upload("splats", a) for a in splats))
    bins = ops.bin_splats(device, uploaded, width, height, 16, gradients=False)
    with pytest.raises(InputError, match="bins: expected lists made with gradients=True"):
        ops.removal(device, uploaded, bins, BACKGROUND)


@pytest.mark.parametrize("clamped", [False, True])
def test_residuals(any_device, clamped):
    """To the bit, where the device has double precision."""
    rng = np.random.default_rng(0)
    image = rng.uniform(-0.5, 1.5, (13, 17, 3)).astype(any_device.real)
    photo = rng.integers(0, 256, image.shape, dtype=np.uint8)
    uploaded = any_device.upload("image", image), any_device.upload("photo", photo, np.uint8)
    found = ops.removal_residuals(any_device, *uploaded, clamped=clamped).get()
    expected = reference.removal_residuals(image.astype(np.float64), photo, clamped=clamped)
    if "cl_khr_fp64" in any_device.cl_device.extensions:
        np.testing.assert_array_equal(found, expected.astype(any_device.real))
    else:
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert expected.max() > 1 or clamped
