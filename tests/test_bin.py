"""Stage bin: the lists of the twin to the entry, and by brute force neither a pixel missing nor a tile too many."""

import numpy as np
import pytest

from clsplat import ops, reference
from clsplat.constants import ALPHA_MIN, EXTENT_SLACK
from clsplat.errors import DeviceError
from clsplat.stages import Bins, Splats
from clsplat.testing import synthetic_scene

TILE_SIZES = pytest.mark.parametrize("tile_size", [8, 16])


def make_splats(n=600, seed=0, width=150, height=110, dtype=np.float32):
    """Splats of `dtype`'s values, from needles to discs wider than the image; some invisible; some of equal depth."""
    gaussians, camera = synthetic_scene(n, seed, width=width, height=height)
    rng = np.random.default_rng(seed)
    gaussians.log_scales[:] = rng.uniform(np.log(0.002), np.log(0.5), (n, 3))
    gaussians.log_scales[:5] = 0.5
    gaussians.logit_opacities[:] = rng.uniform(-6, 6, n)
    splats = reference.project_fwd(gaussians, camera, 0)
    splats = Splats(*(a.astype(dtype).astype(np.float64) for a in splats))
    splats.depths[::3] = np.where(splats.depths[::3] > 0, 3.5, 0)
    assert 0 < (splats.extents[:, 0] == 0).mean() < 0.5
    return splats


def bins_on(device, splats, width, height, tile_size):
    bins = ops.bin_splats(device, Splats(*(device.upload("splats", a) for a in splats)), width, height, tile_size)
    return Bins(*(a.get() for a in bins[:5]), *bins[5:])


def pairs(bins):
    """The set of (tile, splat)."""
    tile = np.repeat(np.arange(len(bins.tile_ranges)), np.diff(bins.tile_ranges)[:, 0])
    return set(zip(tile.tolist(), bins.gauss_ids.tolist(), strict=True))


@TILE_SIZES
def test_double_matches_twin(device64, tile_size):
    splats = make_splats()
    actual = bins_on(device64, splats, 150, 110, tile_size)
    expected = reference.bin_splats(splats, 150, 110, tile_size)
    assert len(expected.gauss_ids) > 2000
    for name in Bins._fields[:5]:
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name), err_msg=name)


@TILE_SIZES
def test_float_matches_twin_but_for_the_border(device, tile_size):
    """Between the twin's lists for ellipses 1e-4 narrower and 1e-4 wider, which hardly differ."""
    splats = make_splats()
    actual = bins_on(device, splats, 150, 110, tile_size)

    def scaled(factor):
        # Wider extents alone would not widen the ellipse, nor would a larger opacity widen the box.
        r2 = 2 * (np.log(np.maximum(splats.opacities / ALPHA_MIN, 1e-9)) + EXTENT_SLACK)
        wider = splats._replace(
            extents=splats.extents * factor, opacities=splats.opacities * np.exp(0.5 * r2 * (factor**2 - 1))
        )
        return pairs(reference.bin_splats(wider, 150, 110, tile_size))

    inner, outer, found = scaled(1 - 1e-4), scaled(1 + 1e-4), pairs(actual)
    assert inner <= found <= outer
    assert len(outer - inner) < 0.005 * len(outer)
    check_structure(actual, splats)


def check_structure(bins, splats):
    """What the containers promise of each other."""
    visible = splats.extents[:, 0] > 0
    np.testing.assert_array_equal(np.sort(bins.order), np.arange(len(visible)))
    np.testing.assert_array_equal(
        bins.order[: visible.sum()],
        np.argsort(np.where(visible, splats.depths, np.inf), kind="stable")[: visible.sum()],
    )
    m = len(bins.gauss_ids)
    assert bins.first_slots[-1] == m == bins.tile_ranges[-1, 1] and bins.tile_ranges[0, 0] == 0
    np.testing.assert_array_equal(bins.tile_ranges[1:, 0], bins.tile_ranges[:-1, 1])
    np.testing.assert_array_equal(np.sort(bins.slots), np.arange(m))
    # A splat's slots lie side by side, and the entry of the list knows its slot.
    owner = np.repeat(bins.order, np.diff(bins.first_slots.astype(np.int64)))
    np.testing.assert_array_equal(owner[bins.slots], bins.gauss_ids)
    rank = np.empty(len(visible), dtype=int)
    rank[bins.order] = np.arange(len(visible))
    for begin, end in bins.tile_ranges:
        assert (np.diff(rank[bins.gauss_ids[begin:end]]) > 0).all(), "a tile's list is in depth order"


def smallest_sigma(conic, low, high):
    """Minimum of sigma over the rectangle [low, high] of offsets from the centre."""
    a, b, c = conic
    if (low <= 0).all() and (high >= 0).all():
        return 0.0
    candidates = []
    for x in (low[0], high[0]):
        y = np.clip(-b * x / c, low[1], high[1])
        candidates.append(0.5 * (a * x * x + c * y * y) + b * x * y)
    for y in (low[1], high[1]):
        x = np.clip(-b * y / a, low[0], high[0])
        candidates.append(0.5 * (a * x * x + c * y * y) + b * x * y)
    return min(candidates)


@TILE_SIZES
def test_complete_and_tight(device64, tile_size):
    """Every pixel with alpha >= ALPHA_MIN is in a listed tile; every listed tile meets the ellipse."""
    width, height = 150, 110
    # Not rounded to float32, by which the conics of needles would cease to fit their extents.
    splats = make_splats(300, 1, dtype=np.float64)
    listed = pairs(bins_on(device64, splats, width, height, tile_size))
    tiles_x = -(-width // tile_size)
    x, y = np.arange(width)[None, :] + 0.5, np.arange(height)[:, None] + 0.5
    tile_of = (np.arange(height)[:, None] // tile_size) * tiles_x + np.arange(width)[None, :] // tile_size
    for g in np.flatnonzero(splats.extents[:, 0] > 0):
        a, b, c = splats.conics[g]
        dx, dy = x - splats.means2d[g, 0], y - splats.means2d[g, 1]
        alpha = splats.opacities[g] * np.exp(-0.5 * (a * dx**2 + c * dy**2) - b * dx * dy)
        missing = {(t, g) for t in np.unique(tile_of[alpha >= ALPHA_MIN]).tolist()} - listed
        assert not missing, f"splat {g} is visible in tiles that do not list it"
    limit = np.log(splats.opacities[[g for _, g in listed]] / ALPHA_MIN) + EXTENT_SLACK
    for (t, g), sigma_max in zip(listed, limit, strict=True):
        origin = np.array([t % tiles_x, t // tiles_x]) * tile_size + 0.5
        last = np.minimum(origin + tile_size - 1, [width - 0.5, height - 0.5])
        sigma = smallest_sigma(splats.conics[g], origin - splats.means2d[g], last - splats.means2d[g])
        assert sigma <= sigma_max * (1 + 1e-9), f"tile {t} lists splat {g}, which does not meet it"


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4099, 3), (3, 1025), (16, 16)])
def test_image_sizes(device64, width, height):
    splats = make_splats(200, 2, 60, 60)
    splats = splats._replace(means2d=splats.means2d / 60 * [width, height])
    actual = bins_on(device64, splats, width, height, 16)
    expected = reference.bin_splats(splats, width, height, 16)
    for name in Bins._fields[:5]:
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name), err_msg=name)


@pytest.mark.parametrize("n", [1, 5])
def test_nothing_visible(any_device, n):
    splats = Splats(*(np.zeros(s) for s in ((n, 2), (n, 3), (n,), (n, 2), (n,), (n, 3))))
    bins = bins_on(any_device, splats, 40, 20, 16)
    assert len(bins.gauss_ids) == len(bins.slots) == 0
    np.testing.assert_array_equal(bins.tile_ranges, 0)
    np.testing.assert_array_equal(bins.first_slots, 0)
    np.testing.assert_array_equal(bins.order, np.arange(n))


def test_many_splats_through_the_radix_sort(configured_device):
    """Both sorts are of the kind for long lists; the lists are the same however a device is configured."""
    splats = make_splats(3000, 3)
    bins = bins_on(configured_device, splats, 150, 110, 16)
    check_structure(bins, splats)
    outside = pairs(bins) ^ pairs(reference.bin_splats(splats, 150, 110, 16))
    assert len(outside) < 0.001 * len(bins.gauss_ids)


def test_too_many_intersections(device):
    """2^32 and more slots are refused before anything of their size is allocated."""
    n = 16385
    one = np.ones(n)
    splats = Splats(
        np.full((n, 2), 4096.0), np.tile([1e-9, 0, 1e-9], (n, 1)), one, np.full((n, 2), 1e5), one, np.ones((n, 3))
    )
    with pytest.raises(DeviceError, match="intersections of Gaussians and tiles: expected a total below 2"):
        bins_on(device, splats, 8192, 8192, 16)
