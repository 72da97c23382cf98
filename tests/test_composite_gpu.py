"""The GPU variant of the stage composite: its batches, tile lists of special lengths, channels, early stop.

What both variants share is tested in test_composite.py.
"""

import numpy as np
import pytest

from clsplat import ops, reference
from clsplat.constants import ALPHA_MIN, EXTENT_SLACK
from clsplat.ops import composite
from clsplat.stages import Image, SplatGrads, Splats

BATCH = composite.GPU_BATCH
# Nothing, one splat, both sides of the border of one batch and of two, and thousands.
LENGTHS = [0, 1, BATCH - 1, BATCH, BATCH + 1, 2 * BATCH, 2 * BATCH + 1, 2000]
TILES_X = 4

# Relative L2 norms. Double: seen 1e-14. Float: seen 7e-6, but on another device rounding may flip a threshold at a
# pixel, which moves it by up to ALPHA_MIN, 7e-4 of the norm of the smallest image.
TOLERANCE = {np.float64: 1e-12, np.float32: 1e-3}


def make_splats(rng, centres, sigma, opacity, channels):
    """Splats at `centres` (n, 2), of standard deviations up to `sigma` px; the opacity varies by a half."""
    n = len(centres)
    angle, s = rng.uniform(0, np.pi, n), sigma * rng.uniform(0.5, 1, (n, 2))
    axes = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1).reshape(n, 2, 2)
    cov = np.einsum("nij,nj,nkj->nik", axes, s**2, axes)
    inverse = np.linalg.inv(cov)
    opacities = opacity * rng.uniform(0.5, 1, n)
    r2 = 2 * (np.log(opacities / ALPHA_MIN) + EXTENT_SLACK)
    extents = np.sqrt(r2[:, None] * np.stack([cov[:, 0, 0], cov[:, 1, 1]], axis=1))
    conics = np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1)
    colors = rng.uniform(0, 1, (n, channels))
    return Splats(centres, conics, rng.uniform(1, 9, n), extents, opacities, colors)


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


def wide_scene(tile_size, splats_number, opacity):
    """One whole tile whose every pixel each splat covers."""
    rng = np.random.default_rng(4)
    centres = tile_size * rng.uniform(0.3, 0.7, (splats_number, 2))
    splats = make_splats(rng, centres, 4 * tile_size, opacity, 3)
    return splats, reference.bin_splats(splats, tile_size, tile_size, tile_size)


def upload(device, splats, bins):
    def copy(container, dtype=None):
        values = [device.upload("test", a, dtype) if isinstance(a, np.ndarray) else a for a in container]
        return type(container)(*values)

    return copy(splats), copy(bins, np.uint32)


def gradient_of_image(bins, channels):
    rng = np.random.default_rng(5)
    return Image(rng.normal(size=(bins.height, bins.width, channels)), rng.normal(size=(bins.height, bins.width)))


def composite_gpu(device, splats, bins, background):
    """Image and gradients by the GPU variant, on the host."""
    v_image = gradient_of_image(bins, len(background))
    # Freed at once, this memory comes back as that of the records: a record left unwritten becomes a NaN.
    device.empty("test", (max(len(bins.gauss_ids), 1), 6 + len(background))).fill(np.nan)
    splats, bins = upload(device, splats, bins)
    image = ops.composite_fwd(device, splats, bins, background, compositor="gpu")
    v_image = Image(*(device.upload("test", a) for a in v_image))
    v = ops.composite_bwd(device, splats, bins, image, v_image, compositor="gpu")
    return Image(*(a.get() for a in image)), SplatGrads(*(a.get() for a in v))


def twin(splats, bins, background):
    image = reference.composite_fwd(splats, bins, background)
    return image, reference.composite_bwd(splats, bins, image, gradient_of_image(bins, len(background)))


def assert_close(found, expected, tolerance):
    for name, a, b in zip(expected._fields, found, expected, strict=True):
        error = np.linalg.norm(a - b) / np.linalg.norm(b)
        assert error <= tolerance, f"{name}: relative error {error:.1e}"


@pytest.mark.parametrize(("tile_size", "channels"), [(8, 1), (16, 3), (16, 4)])
def test_lists_of_special_lengths_match_the_twin(device64, tile_size, channels):
    """Tile by tile, so that the list of thousands does not hide an error in the list of one."""
    splats, bins = listed_scene(tile_size, channels)
    background = np.linspace(0.2, 0.8, channels)
    image, v = composite_gpu(device64, splats, bins, background)
    expected_image, expected_v = twin(splats, bins, background)
    for t, (begin, end) in enumerate(bins.tile_ranges):
        y, x = t // TILES_X * tile_size, t % TILES_X * tile_size
        pixels = np.s_[y : y + tile_size, x : x + tile_size]
        np.testing.assert_allclose(image.image[pixels], expected_image.image[pixels], rtol=1e-12)
        g = bins.gauss_ids[begin:end]
        if len(g):
            rows = [SplatGrads(*(a[g] for a in gradients)) for gradients in (v, expected_v)]
            assert_close(*rows, TOLERANCE[np.float64])


@pytest.mark.parametrize(("tile_size", "channels"), [(8, 1), (16, 4)])
def test_float_build_matches_the_twin(device, tile_size, channels):
    splats, bins = listed_scene(tile_size, channels)
    background = np.linspace(0.2, 0.8, channels)
    image, v = composite_gpu(device, splats, bins, background)
    expected_image, expected_v = twin(splats, bins, background)
    assert_close(image, expected_image, TOLERANCE[np.float32])
    assert_close(v, expected_v, TOLERANCE[np.float32])


@pytest.mark.parametrize("batch", [1, 48, 128])
def test_the_batch_changes_no_bit(device64, monkeypatch, batch):
    """Also where a batch exceeds the 64 pixels of a tile, or is a single splat."""
    splats, bins = listed_scene(8, 3)
    background = np.array([0.1, 0.5, 0.9])
    image, v = composite_gpu(device64, splats, bins, background)
    monkeypatch.setattr(composite, "GPU_BATCH", batch)
    other_image, other_v = composite_gpu(device64, splats, bins, background)
    for a, b in zip([*image, *v], [*other_image, *other_v], strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("tile_size", [8, 16])
@pytest.mark.parametrize("splats_number", [1, BATCH, BATCH + 1])
def test_every_splat_meets_every_pixel(device64, tile_size, splats_number):
    """The corners too, which the first and the last step of a batch reach."""
    splats, bins = wide_scene(tile_size, splats_number, 0.03)
    background = np.array([0.1, 0.5, 0.9])
    image, v = composite_gpu(device64, splats, bins, background)
    expected_image, expected_v = twin(splats, bins, background)
    assert_close(image, expected_image, TOLERANCE[np.float64])
    assert_close(v, expected_v, TOLERANCE[np.float64])


@pytest.mark.parametrize("tile_size", [8, 16])
@pytest.mark.parametrize("splats_number", [BATCH, BATCH + 1, 5 * BATCH + 7])
def test_splats_behind_an_early_stop_get_zeros(any_device, tile_size, splats_number):
    splats, bins = wide_scene(tile_size, splats_number, 0.98)
    background = np.zeros(3)
    image, v = composite_gpu(any_device, splats, bins, background)
    expected_image, expected_v = twin(splats, bins, background)
    behind = bins.gauss_ids[BATCH // 2 :]
    assert not expected_v.colors[behind].any(), "the scene must stop within half a batch"
    for a in v:
        assert not a[behind].any()
    assert_close(image, expected_image, TOLERANCE[any_device.real.type])
    assert_close(v, expected_v, TOLERANCE[any_device.real.type])


def test_no_intersections_leave_the_background(any_device):
    splats, _ = listed_scene(8, 3)
    splats = splats._replace(extents=np.zeros_like(splats.extents))
    bins = reference.bin_splats(splats, 19, 13, 8)
    assert not bins.tile_ranges.any()
    background = np.array([0.25, 0.5, 0.75])
    unused = np.zeros(1)  # a buffer cannot be empty
    image, v = composite_gpu(any_device, splats, bins._replace(gauss_ids=unused, slots=unused), background)
    assert (image.image == background).all() and not image.alpha.any()
    assert not any(a.any() for a in v)
