"""The stages of radiance fields in the test of a device (`clsplat.selftest`): each against its twin."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from clsplat import reference
from clsplat.field_stages import NO_ROW, HashLevels, Marching, Span

Found = Iterator[tuple[Any, Any]]
"""Pairs of an array of the device and that of the twin."""

RAYS, SAMPLES, CELLS = 7, 120, 3


def up(b: Any, *arrays: Any) -> list[Any]:
    """Arrays on the device."""
    return [b.up(array) for array in arrays]


def directions(b: Any) -> np.ndarray:
    """Unit vectors, one for each ray."""
    vectors = b.random(RAYS, 3)
    return b.rounded(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def test_rays(b: Any) -> Found:
    first, background = np.linspace(0, SAMPLES, RAYS + 1).astype(np.uint32), (0.2, 0.5, 0.8)
    sigmas, colors = np.abs(b.random(SAMPLES)), np.abs(b.random(SAMPLES, 3))
    deltas, v_rgb = b.rounded(np.full(SAMPLES, 0.05)), b.random(RAYS, 3)
    samples, uploaded = (sigmas, colors, deltas, first), up(b, sigmas, colors, deltas, first)
    image = b.stages.rays_fwd(*uploaded, background)
    expected = reference.rays_fwd(*samples, background)
    yield from zip(image, expected, strict=True)
    v = b.stages.rays_bwd(*uploaded, background, image.transmittances, b.up(v_rgb))
    wanted = reference.rays_bwd(*samples, background, expected.transmittances, v_rgb)
    yield from zip(v, wanted, strict=True)


def test_march(b: Any) -> Found:
    """Rays along the axes, whose samples no rounding moves to another cell."""
    origins = b.rounded([[0.3, 0.4, -1], [-1, 0.6, 0.2], [0.7, -1, 0.6]])
    along, offsets = b.rounded(np.eye(3)[[2, 0, 1]]), b.rounded([0.3, 0.5, 0.7])
    occupied = b.rng.integers(0, 2, (4, 4, 4)).astype(np.uint8)
    occupied[:, 1, 1] = 1  # the first ray has samples
    marching = Marching(step=0.03, cone=0.0, near=0.0, far=10.0, contracted=False)
    found = b.stages.march(*up(b, origins, along, offsets, occupied), marching)
    expected = reference.march(origins, along, offsets, occupied, marching)
    yield found.first, expected.first
    yield found.positions, expected.positions
    yield found.deltas, expected.deltas


def test_spheres(b: Any) -> Found:
    """In a grid without empty cells, so that no rounding moves samples to them."""
    origins, along, offsets = b.rounded(0.3 * directions(b)), directions(b), b.rounded(np.linspace(0.1, 0.9, RAYS))
    given = origins, along, offsets, np.ones((5, 2, 4), np.uint8)
    found, expected = b.stages.spheres(*up(b, *given), 0.1), reference.spheres(*given, 0.1)
    yield found.first, expected.first
    yield found.positions, expected.positions
    yield found.deltas, expected.deltas


def test_hashgrid(b: Any) -> Found:
    levels = HashLevels.geometric(3, 4, 16, 512)
    positions = b.rounded(b.rng.uniform(0.01, 0.99, (SAMPLES, 3)))
    table, v = b.random(levels.offsets[-1], 2), b.random(SAMPLES, 2 * len(levels.resolutions))
    found = b.stages.hashgrid_fwd(b.up(positions), b.up(table), levels)
    yield found, reference.hashgrid_fwd(positions, table, levels)
    yield b.stages.hashgrid_bwd(b.up(positions), b.up(v), levels), reference.hashgrid_bwd(positions, v, levels)


def test_mlp(b: Any) -> Found:
    widths = (32, 64, 16)
    inputs, weights, v = b.random(SAMPLES, 32), b.random(32 * 64 + 64 * 16), b.random(SAMPLES, 16)
    on_device = up(b, inputs, weights)
    outputs, hidden = b.stages.mlp_fwd(*on_device, widths)
    expected, expected_hidden = reference.mlp_fwd(inputs, weights, widths)
    yield outputs, expected
    found = b.stages.mlp_bwd(*on_device, widths, hidden, b.up(v), 32)
    yield from zip(found, reference.mlp_bwd(inputs, weights, widths, expected_hidden, v, 32), strict=True)


def test_voxels(b: Any) -> Found:
    count = (CELLS + 1) ** 3
    corners = np.flatnonzero(np.arange(count) % 5).astype(np.uint32)
    rows = np.full(count, NO_ROW, np.uint32)
    rows[corners] = np.arange(len(corners))
    index = rows.reshape((CELLS + 1,) * 3)
    positions, table = b.rounded(b.rng.uniform(size=(SAMPLES, 3))), b.random(len(corners), 28)
    v, part = b.random(SAMPLES, 28), (0, len(corners))
    on_device = up(b, positions, index)
    yield b.stages.voxels_fwd(*on_device, b.up(table)), reference.voxels_fwd(positions, index, table)
    v_table = reference.voxels_bwd(positions, index, len(corners), v)
    found = b.stages.voxels_bwd(*on_device, len(corners), b.up(v))
    yield found, v_table
    reference.voxels_tv(index, corners, table, v_table, (2.0, 0.5), *part)
    b.stages.voxels_tv(on_device[1], b.up(corners), b.up(table), found, (2.0, 0.5), *part)
    yield found, v_table


def test_heads(b: Any) -> Found:
    rays_of = b.rng.integers(0, RAYS, SAMPLES).astype(np.uint32)
    features, outputs, vectors = b.random(SAMPLES, 16), b.random(SAMPLES, 16), directions(b)
    where = vectors, rays_of
    on_device = up(b, *where)
    yield b.stages.heads_join(b.up(features), *on_device), reference.heads_join(features, *where)
    yield from zip(b.stages.heads_fwd(*up(b, features, outputs)), reference.heads_fwd(features, outputs), strict=True)
    colors, v_colors, v_sigmas = b.rounded(b.rng.uniform(size=(SAMPLES, 3))), b.random(SAMPLES, 3), b.random(SAMPLES)
    yield b.stages.heads_bwd(*up(b, colors, v_colors)), reference.heads_bwd(colors, v_colors)
    joined = b.random(SAMPLES, 32), features, b.rounded(np.exp(features[:, 0])), v_sigmas
    yield b.stages.heads_join_bwd(*up(b, *joined)), reference.heads_join_bwd(*joined)
    harmonics = b.random(SAMPLES, 28)
    yield from zip(
        b.stages.heads_sh_fwd(b.up(harmonics), *on_device, 2.0),
        reference.heads_sh_fwd(harmonics, *where, 2.0),
        strict=True,
    )
    v = v_sigmas, v_colors
    yield (
        b.stages.heads_sh_bwd(b.up(harmonics), *on_device, 2.0, *up(b, *v)),
        reference.heads_sh_bwd(harmonics, *where, 2.0, *v),
    )
    joint = b.random(SAMPLES, 16)
    soft, v_soft = joint.copy(), b.up(joint)
    yield from zip(
        b.stages.heads_soft_fwd(*up(b, features, outputs), 2.0),
        reference.heads_soft_fwd(features, outputs, 2.0),
        strict=True,
    )
    b.stages.heads_soft_bwd(b.up(features), 2.0, b.up(v_sigmas), v_soft)
    reference.heads_soft_bwd(features, 2.0, v_sigmas, soft)
    yield v_soft, soft


def test_encode(b: Any) -> Found:
    points = b.rounded(b.rng.uniform(-1, 1, (SAMPLES, 3)))
    yield b.stages.encode_points(b.up(points), 4), reference.encode_points(points, 4)
    features, rows, v = b.random(SAMPLES, 16), b.random(SAMPLES // 4, 16), b.random(SAMPLES, 32)
    joined = b.stages.encode_join(*up(b, features, rows), True)
    yield joined, reference.encode_join(features, rows, True)
    yield b.stages.encode_join_bwd(*up(b, v, features), True), reference.encode_join_bwd(v, features, True)


def intervals(b: Any) -> tuple[np.ndarray, np.ndarray]:
    """Edges of the intervals of rays, ascending, and a place in each."""
    count = SAMPLES // 6
    return b.rounded(np.sort(b.rng.uniform(size=(RAYS, count + 1)), axis=1)), b.rounded(
        b.rng.uniform(size=(RAYS, count))
    )


def test_intervals(b: Any) -> Found:
    edges, offsets = intervals(b)
    along = directions(b)
    rays = b.rounded(0.5 - 2 * along), along, edges, offsets
    for span in (Span(0.0, 1e6, False), Span(0.1, 20.0, True)):
        found = b.stages.intervals_along(*up(b, *rays), span)
        yield from zip(found, reference.intervals_along(*rays, span), strict=True)
    given = edges, b.rounded(b.rng.uniform(0.5, 1, offsets.size)), offsets
    how = 0.01, 0.5, True
    yield b.stages.intervals_resample(*up(b, *given), *how), reference.intervals_resample(*given, *how)


def test_weights(b: Any) -> Found:
    sigmas, deltas = np.abs(b.random(SAMPLES)), b.rounded(np.full(SAMPLES, 0.05))
    v, count = b.random(SAMPLES), SAMPLES // 6
    weights = reference.weights_fwd(sigmas, deltas, count)
    given = sigmas, deltas
    yield b.stages.weights_fwd(*up(b, *given), count), weights
    found, expected = b.up(v), v.copy()
    b.stages.weights_bwd(*up(b, *given), count, *up(b, b.rounded(weights), v), found)
    reference.weights_bwd(*given, count, weights, v, expected)
    yield found, expected


def test_frustums(b: Any) -> Found:
    edges, along, radii = intervals(b)[0], directions(b), b.rounded(b.rng.uniform(0.01, 0.02, RAYS))
    for rays, span in (
        (b.rounded(0.5 - 2 * along), Span(0.0, 1e6, False)),
        (b.rounded(0.2 * along), Span(0.1, 20.0, True)),
    ):
        # At four frequencies, rounding is far below the error that counts.
        found = b.stages.frustums_encode(*up(b, rays, along, radii, edges), span, 4)
        yield from zip(found, reference.frustums_encode(rays, along, radii, edges, span, 4), strict=True)


def test_histograms(b: Any) -> Found:
    edges, outer = intervals(b)[0], intervals(b)[0]
    weights, bounds = (b.rounded(b.rng.uniform(size=RAYS * (edges.shape[1] - 1))) for _ in range(2))
    given = edges, weights, outer, b.rounded(0.3 * bounds)
    found = b.stages.histograms_interlevel(*up(b, *given), 0.5)
    yield from zip(found, reference.histograms_interlevel(*given, 0.5), strict=True)
    found = b.stages.histograms_distortion(*up(b, *given[:2]), 0.5)
    yield from zip(found, reference.histograms_distortion(*given[:2], 0.5), strict=True)
