"""The GPU variant of the stage composite where its batches begin and end.

What both variants share is tested in test_composite.py.
"""

import numpy as np
import pytest
from device_opening import open_device
from tolerances import DOUBLE

from clsplat import ops, reference
from clsplat.constants import ALPHA_MIN, EXTENT_SLACK
from clsplat.ops import composite
from clsplat.stages import Image, SplatGrads, Splats
from clsplat.testing import assert_matches

TILE_SIZES = pytest.mark.parametrize("tile_size", [8, 16])
BATCH = composite.GPU_BATCH  # where there are subgroups, smaller batches divide it
# Nothing, one splat, both sides of the end of one batch and of two, and thousands.
LENGTHS = [0, 1, BATCH - 1, BATCH, BATCH + 1, 2 * BATCH, 2 * BATCH + 1, 2000]
TILES_X = 4


def make_splats(rng, centres, sigma, opacity, channels):
    """Splats at `centres` (n, 2), of standard deviations and opacities from half of what is given up to that."""
    n = len(centres)
    angle, s = rng.uniform(0, np.pi, n), sigma * rng.uniform(0.5, 1, (n, 2))
    axes = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1).reshape(n, 2, 2)
    cov = np.einsum("nij,nj,nkj->nik", axes, s**2, axes)
    opacities = opacity * rng.uniform(0.5, 1, n)
    r2 = 2 * (np.log(opacities / ALPHA_MIN) + EXTENT_SLACK)
    extents = np.sqrt(r2[:, None] * cov[:, [0, 1], [0, 1]])
    conics = np.linalg.inv(cov)[:, [0, 0, 1], [0, 1, 1]]
    return Splats(centres, conics, rng.uniform(1, 9, n), extents, opacities, rng.uniform(0, 1, (n, channels)))


def listed_scene(tile_size, channels):
    """Splats that each lie in one tile, LENGTHS[t] of them in tile t, and their bins.

    The image cuts off the last column and the last row of tiles.
    """
    rng = np.random.default_rng(3)
    tile = np.repeat(np.arange(len(LENGTHS)), LENGTHS)
    origin = np.stack([tile % TILES_X, tile // TILES_X], axis=1) * tile_size
    centres = origin + tile_size * rng.uniform(0.47, 0.53, (len(tile), 2))
    # At opacity 0.1 a splat is visible up to 2.6 standard deviations: it stays inside its tile.
    splats = make_splats(rng, centres, 0.17 * tile_size, 0.1, channels)
    bins = reference.bin_splats(splats, TILES_X * tile_size - 3, len(LENGTHS) // TILES_X * tile_size - 2, tile_size)
    assert np.diff(bins.tile_ranges)[:, 0].tolist() == LENGTHS
    return splats, bins


def wide_scene(tile_size, n, opacity):
    """One whole tile whose every pixel each of the n splats covers."""
    rng = np.random.default_rng(4)
    centres = tile_size * rng.uniform(0.3, 0.7, (n, 2))
    splats = make_splats(rng, centres, 4 * tile_size, opacity, 3)
    return splats, reference.bin_splats(splats, tile_size, tile_size, tile_size)


def background_and_gradient(splats, bins):
    channels = splats.colors.shape[1]
    rng = np.random.default_rng(5)
    shape = (bins.height, bins.width)
    return rng.uniform(0, 1, channels), Image(rng.normal(size=(*shape, channels)), rng.normal(size=shape))


def composite_gpu(device, splats, bins, between=lambda: None):
    """Image, alpha and the four gradients by the GPU variant, by name. `between` is called between both passes."""
    background, v_image = background_and_gradient(splats, bins)
    # Freed at once, this memory comes back as that of the records: a record left unwritten becomes a NaN.
    device.empty("records", (len(bins.gauss_ids), 6 + len(background))).fill(np.nan)
    splats = Splats(*(device.upload("splats", a) for a in splats))
    bins = bins._replace(
        **{k: device.upload(k, a, np.uint32) for k, a in bins._asdict().items() if isinstance(a, np.ndarray)}
    )
    image = ops.composite_fwd(device, splats, bins, background, compositor="gpu")
    v_image = Image(*(device.upload("v_image", a) for a in v_image))
    between()
    v = ops.composite_bwd(device, splats, bins, image, v_image, compositor="gpu")
    return {k: a.get() for k, a in by_name(image, v).items()}


def composite_twin(splats, bins):
    background, v_image = background_and_gradient(splats, bins)
    image = reference.composite_fwd(splats, bins, background)
    return by_name(image, reference.composite_bwd(splats, bins, image, v_image))


def by_name(image, v):
    return image._asdict() | {f"v_{name}": array for name, array in v._asdict().items()}


@pytest.mark.parametrize(("tile_size", "channels"), [(8, 1), (8, 3), (16, 3), (16, 4)])
def test_lists_of_special_lengths(device64, tile_size, channels):
    """Tile by tile, so that the list of thousands does not hide an error in the list of one."""
    splats, bins = listed_scene(tile_size, channels)
    found, expected = composite_gpu(device64, splats, bins), composite_twin(splats, bins)
    for t, (begin, end) in enumerate(bins.tile_ranges):
        y, x = t // TILES_X * tile_size, t % TILES_X * tile_size
        pixels = np.s_[y : y + tile_size, x : x + tile_size]
        for name in expected:
            part = pixels if name in Image._fields else bins.gauss_ids[begin:end]
            assert_matches(name, found[name][part], expected[name][part], DOUBLE)


@TILE_SIZES
@pytest.mark.parametrize("n", [1, BATCH, BATCH + 1, 3 * composite.SEGMENT])
def test_every_splat_meets_every_pixel(device64, tile_size, n):
    """The corners too, which the first and the last step of a batch reach; and pixels that stop in later segments."""
    splats, bins = wide_scene(tile_size, n, 0.03)
    found, expected = composite_gpu(device64, splats, bins), composite_twin(splats, bins)
    for name in expected:
        assert_matches(name, found[name], expected[name], DOUBLE)


@TILE_SIZES
@pytest.mark.parametrize("n", [BATCH, BATCH + 1, 5 * BATCH + 7])
def test_splats_behind_an_early_stop_get_zeros(device64, tile_size, n):
    splats, bins = wide_scene(tile_size, n, 0.98)
    found, expected = composite_gpu(device64, splats, bins), composite_twin(splats, bins)
    behind = bins.gauss_ids[BATCH // 2 :]
    assert not expected["v_colors"][behind].any(), "the scene must stop within half a batch"
    for name in SplatGrads._fields:
        assert not found[f"v_{name}"][behind].any()
    for name in expected:
        assert_matches(name, found[name], expected[name], DOUBLE)


@pytest.mark.parametrize("largest", [100, 16])
def test_a_work_item_may_have_several_pixels(largest):
    """On devices whose groups are smaller than a tile: some Mali and Adreno, Apple's CPU device."""
    device = open_device(np.float64)
    device.largest_group = largest  # shadows the cached property
    splats, bins = listed_scene(16, 3)
    found, expected = composite_gpu(device, splats, bins), composite_twin(splats, bins)
    for name in expected:
        assert_matches(name, found[name], expected[name], DOUBLE)


def test_another_image_between_both_passes(device64):
    """Its states replace those of the first image, which are then computed again."""
    (splats, bins), (others, other_bins) = wide_scene(8, 2 * composite.SEGMENT + 1, 0.03), wide_scene(8, 300, 0.03)
    expected = composite_gpu(device64, splats, bins)
    found = composite_gpu(device64, splats, bins, between=lambda: composite_gpu(device64, others, other_bins))
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


def test_other_lists_of_the_same_splats_between_both_passes(device64):
    """States belong to the lists too."""
    splats, _ = wide_scene(32, 3 * composite.SEGMENT, 0.03)
    splats = Splats(*(device64.upload("splats", a) for a in splats))
    small, large = (ops.bin_splats(device64, splats, 32, 32, size) for size in (8, 32))
    background, v_image = background_and_gradient(splats, small)
    v_image = Image(*(device64.upload("v_image", a) for a in v_image))
    image = ops.composite_fwd(device64, splats, small, background, compositor="gpu")
    expected = ops.composite_bwd(device64, splats, small, image, v_image, compositor="gpu")
    ops.composite_fwd(device64, splats, large, background, compositor="gpu")
    found = ops.composite_bwd(device64, splats, small, image, v_image, compositor="gpu")
    for name in SplatGrads._fields:
        np.testing.assert_array_equal(getattr(found, name).get(), getattr(expected, name).get(), err_msg=name)


@pytest.mark.parametrize("batch", [1, 48, 128])
def test_the_batch_changes_no_bit(device64, monkeypatch, batch):
    """Also where a batch exceeds the 64 pixels of a tile, or is a single splat."""
    splats, bins = listed_scene(8, 3)
    expected = composite_gpu(device64, splats, bins)
    monkeypatch.setattr(composite, "gpu_batch", lambda device: batch)
    found = composite_gpu(device64, splats, bins)
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


@pytest.mark.parametrize("real", [np.float32, np.float64])
@TILE_SIZES
def test_subgroups_change_no_bit(real, tile_size):
    """With them and without; also where a batch is more than one subgroup, whose barrier is then the group's."""
    device = open_device(real)
    if not device.subgroup_size:
        pytest.skip(f"{device.label} has no subgroups")
    splats, bins = listed_scene(tile_size, 3)
    found = composite_gpu(device, splats, bins)
    for size in (0, 4 * device.subgroup_size):
        other = open_device(real)
        other.subgroup_size = size  # shadows the cached property
        expected = composite_gpu(other, splats, bins)
        for name in expected:
            np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
