"""Stage bin: the lists of the twin to the entry, and by brute force neither a pixel missing nor a tile too many."""

import functools

import numpy as np
import pytest
from device_opening import open_device

from clsplat import ops, reference
from clsplat.constants import ALPHA_MIN, EXTENT_SLACK
from clsplat.device import Device
from clsplat.errors import DeviceError, InputError
from clsplat.ops.sort import BITONIC_MAX, CPU_SHORT_SEGMENT
from clsplat.stages import Bins, Splats
from clsplat.testing import synthetic_scene

SCHEMES = pytest.mark.parametrize("scheme", ["global", "per_tile"])
TILE_SIZES = pytest.mark.parametrize("tile_size", [8, 16, 32])


def make_splats(n=601, seed=0, width=150, height=110, dtype=np.float32):
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


def bins_on(device, splats, width, height, tile_size, **options):
    arrays = Splats(*(device.upload("splats", a) for a in splats))
    bins = ops.bin_splats(device, arrays, width, height, tile_size, **options)
    return Bins(*(None if a is None else a.get() for a in bins[:4]), *bins[4:])


def assert_same(actual, expected, fields=Bins._fields[:4]):
    for name in fields:
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name), err_msg=name)


def pairs(bins):
    """The set of (tile, splat)."""
    tile = np.repeat(np.arange(len(bins.tile_ranges)), np.diff(bins.tile_ranges)[:, 0])
    return set(zip(tile.tolist(), bins.gauss_ids.tolist(), strict=True))


@SCHEMES
@TILE_SIZES
def test_double_matches_twin(device64, tile_size, scheme):
    splats = make_splats()
    actual = bins_on(device64, splats, 150, 110, tile_size, scheme=scheme)
    expected = reference.bin_splats(splats, 150, 110, tile_size, scheme=scheme)
    assert len(expected.gauss_ids) > 1500
    assert_same(actual, expected)


@pytest.fixture(scope="module", params=["float32", "float64", "float32 as a GPU", "float64 as a GPU"])
def each_device(request):
    """Both precisions, each as the device is and launched like a GPU."""
    device = open_device(request.param.split()[0])
    if "GPU" in request.param:
        device.is_cpu = False  # shadows the cached property
    return device


@functools.cache
def crowd():
    """Splats by the thousand in some tiles of 16 pixels, single ones in others, none in most; many of equal depth."""
    splats = make_splats(5999, 4, 60, 60)
    splats.means2d[:, 0] += 300
    splats.extents[::7] = 0
    bins = reference.bin_splats(splats, 400, 64, 16)
    lengths = np.diff(bins.tile_ranges)[:, 0]
    assert lengths.max() > BITONIC_MAX and 0 in lengths and 0 < np.median(lengths[lengths > 0]) < BITONIC_MAX
    assert ((lengths > 0) & (lengths <= CPU_SHORT_SEGMENT)).any()
    assert len(np.unique(splats.depths)) < 0.8 * len(splats.depths)
    return splats, bins


def test_both_schemes_give_the_same_lists(each_device):
    """To the bit, with and without what gradients need."""
    splats, expected = crowd()
    for_all = bins_on(each_device, splats, 400, 64, 16, scheme="global")
    check_structure(for_all, splats)
    per_tile = bins_on(each_device, splats, 400, 64, 16, scheme="per_tile")
    assert_same(per_tile, for_all)
    for scheme in ("auto", "global", "per_tile"):
        forward = bins_on(each_device, splats, 400, 64, 16, scheme=scheme, gradients=False)
        assert forward.slots is None and forward.first_slots is None
        assert_same(forward, for_all, ("gauss_ids", "tile_ranges"))
    if each_device.real == np.float64:
        assert_same(for_all, expected)


@pytest.mark.parametrize("y", [15.8, 16.2])
def test_between_the_pixel_centres_of_two_tiles(any_device, y):
    """A disc whose box, but no row of pixel centres that it meets, reaches into the other tile."""
    splats = make_splats(50)
    r2 = 2 * (np.log(0.9 / ALPHA_MIN) + EXTENT_SLACK)
    for array, value in zip(splats, ([8.5, y], np.array([1, 0, 1]) * r2 / 0.6**2, 1, 0.6, 0.9, 1), strict=True):
        array[:] = value
    bins = bins_on(any_device, splats, 16, 32, 16)
    tile = int(y > 16)
    np.testing.assert_array_equal(np.diff(bins.tile_ranges)[:, 0], [50 * (1 - tile), 50 * tile])


def test_twin_without_gradients():
    splats = make_splats(50)
    bins = reference.bin_splats(splats, 150, 110, 16, gradients=False)
    assert bins.slots is None and bins.first_slots is None
    assert_same(bins, reference.bin_splats(splats, 150, 110, 16), ("gauss_ids", "tile_ranges"))


def test_an_unknown_scheme(device):
    with pytest.raises(InputError, match="scheme: expected auto, global or per_tile, found 'tiles'"):
        bins_on(device, make_splats(50), 150, 110, 16, scheme="tiles")


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
    by_depth = np.argsort(np.where(visible, splats.depths, np.inf), kind="stable")
    m = len(bins.gauss_ids)
    assert bins.first_slots[-1] == m == bins.tile_ranges[-1, 1] and bins.tile_ranges[0, 0] == 0
    np.testing.assert_array_equal(bins.tile_ranges[1:, 0], bins.tile_ranges[:-1, 1])
    np.testing.assert_array_equal(np.sort(bins.slots), np.arange(m))
    # A splat's slots lie side by side, and the entry of the list knows its slot.
    owner = np.repeat(np.arange(len(visible)), np.diff(bins.first_slots.astype(np.int64)))
    np.testing.assert_array_equal(owner[bins.slots], bins.gauss_ids)
    rank = np.empty(len(visible), dtype=int)
    rank[by_depth] = np.arange(len(visible))
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
    assert_same(actual, reference.bin_splats(splats, width, height, 16))


@SCHEMES
@pytest.mark.parametrize("size", [(120, 96), (121, 96), (120, 97), (300, 200)])
def test_splats_as_large_as_a_record_and_larger(each_device, size, scheme):
    """Discs around an image of 15x12 tiles, as many as a record of a splat's tiles holds, and of more."""
    rng = np.random.default_rng(0)
    splats = make_splats(40)
    radius = np.repeat([100.0, 1000.0, 3.0], [10, 10, 20])
    r2 = 2 * (np.log(0.9 / ALPHA_MIN) + EXTENT_SLACK)
    splats.means2d[:] = rng.uniform(0, size, (40, 2))
    splats.conics[:] = [1, 0, 1] * (r2 / radius**2)[:, None]
    splats.extents[:] = radius[:, None]
    splats.opacities[:] = 0.9
    splats = Splats(*(a.astype(np.float32).astype(np.float64) for a in splats))
    bins = bins_on(each_device, splats, *size, 8, scheme=scheme)
    check_structure(bins, splats)
    if each_device.real == np.float64:
        assert_same(bins, reference.bin_splats(splats, *size, 8))


@SCHEMES
@pytest.mark.parametrize("n", [1, 5])
def test_nothing_visible(each_device, n, scheme):
    splats = Splats(*(np.zeros(s) for s in ((n, 2), (n, 3), (n,), (n, 2), (n,), (n, 3))))
    forward = bins_on(each_device, splats, 40, 20, 16, scheme=scheme, gradients=False)
    assert len(forward.gauss_ids) == 0 and not forward.tile_ranges.any()
    bins = bins_on(each_device, splats, 40, 20, 16, scheme=scheme)
    assert len(bins.gauss_ids) == len(bins.slots) == 0
    np.testing.assert_array_equal(bins.tile_ranges, 0)
    np.testing.assert_array_equal(bins.first_slots, 0)


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


@pytest.mark.parametrize("variants", ["cpu", "gpu"])
def test_lists_longer_than_the_last_ones(monkeypatch, variants):
    """Their kernel, queued with too little room, writes nothing and runs again."""
    monkeypatch.setenv("CLSPLAT_VARIANTS", variants)
    device = open_device(np.float64)
    few, many = make_splats(30, seed=1), make_splats()
    launched = []
    launch = Device.launch

    def recorded(self, stage, kernel, *arguments, **options):
        launched.append(kernel)
        launch(self, stage, kernel, *arguments, **options)

    monkeypatch.setattr(Device, "launch", recorded)
    for splats, runs in ((few, 2), (few, 1), (many, 2), (many, 1), (few, 1), (many, 2)):
        launched.clear()
        actual = bins_on(device, splats, 150, 110, 16)
        assert_same(actual, reference.bin_splats(splats, 150, 110, 16))
        assert sum(kernel in ("bin_scatter", "bin_emit") for kernel in launched) == runs


def test_little_memory_for_lists_as_long_as_the_last_ones():
    """Shorter lists fit where those of the last length, which are tried first, do not."""
    device = open_device(np.float64)
    few, many = make_splats(30, seed=1), make_splats(3000)
    expected = bins_on(device, few, 150, 110, 16)
    bins_on(device, many, 150, 110, 16)
    device.buffers.pool.free_held()
    m = device.lengths["intersections"]
    held = device.upload("held", np.zeros(4 * m, np.uint32), np.uint32)
    device.buffers._limit = device.memory + 3 * m  # less than a list of m entries of 4 bytes
    assert len(held)
    assert_same(bins_on(device, few, 150, 110, 16), expected)
