"""Stage spheres: crossings in numbers, lengths of contracted rays, empty cells, against the twin."""

import numpy as np
import pytest
from tolerances import DOUBLE

from clsplat import ops, reference
from clsplat.reference.march import contract
from clsplat.testing import assert_matches

CELLS = 7, 6, 12  # depths, latitudes, longitudes


def rays(count=80, share=0.5, seed=0):
    """Rays from the ball and a little outside, one along a pole, and a grid of which `share` is occupied."""
    rng = np.random.default_rng(seed)
    origins, directions = rng.uniform(-0.8, 0.8, (count, 3)), rng.normal(size=(count, 3))
    origins[0], directions[0] = 0, [0, 1, 0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    occupied = (rng.uniform(size=CELLS) < share).astype(np.uint8)
    arrays = (a.astype(np.float32).astype(np.float64) for a in (origins, directions, rng.uniform(size=count)))
    return [*arrays, occupied]


def by_kernel(device, origins, directions, offsets, occupied, near):
    arrays = [device.upload("rays", a) for a in (origins, directions, offsets)]
    samples = ops.spheres(device, *arrays, device.upload("occupied", occupied, np.uint8), near)
    kept = slice(0, samples.total)
    return samples._replace(**{k: getattr(samples, k).get()[kept] for k in ("positions", "deltas", "rays_of")},
                            first=samples.first.get())  # fmt: skip


def both(device):
    return (reference.spheres, lambda *given: by_kernel(device, *given))


def test_in_numbers(any_device):
    """From the centre along -y, and from (-1/2, 0, 0) along z: radii of 4/3 and 4, halfway between spheres."""
    origins, directions = np.array([[0.0, 0, 0], [-0.5, 0, 0]]), np.array([[0.0, -1, 0], [0, 0, 1]])
    given = origins, directions, np.array([0.5, 0.5]), np.ones((2, 1, 1), np.uint8), 0.0
    # The second ray leaves the sphere of radius r at x = -1/2, z = sqrt(r^2 - 1/4).
    longitudes = [0.5 + np.arctan2(-0.5, np.sqrt(r**2 - 0.25)) / (2 * np.pi) for r in (4 / 3, 4)]
    for run in both(any_device):
        samples = run(*given)
        np.testing.assert_array_equal(samples.first, [0, 2, 4])
        np.testing.assert_array_equal(samples.rays_of, [0, 0, 1, 1])
        np.testing.assert_allclose(samples.positions[:2, 1:], [[1, 0.25], [1, 0.75]], atol=1e-6)
        np.testing.assert_allclose(samples.positions[2:, 0], longitudes, atol=1e-6)
        np.testing.assert_allclose(samples.positions[2:, 1:], [[0.5, 0.25], [0.5, 0.75]], atol=1e-6)
        np.testing.assert_allclose(samples.deltas[:2], [0.5, 0.5], rtol=1e-6)  # along a radius


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("near", [0.01, 2.5], ids=["near", "behind a sphere"])
def test_matches_twin(device64, share, near):
    given = *rays(share=share), near
    found, expected = by_kernel(device64, *given), reference.spheres(*given)
    assert (expected.total > 0) == (share > 0)
    np.testing.assert_array_equal(found.first, expected.first)
    np.testing.assert_array_equal(found.rays_of, expected.rays_of)
    assert_matches("positions", found.positions, expected.positions, DOUBLE)
    assert_matches("deltas", found.deltas, expected.deltas, DOUBLE)


def test_single_precision_finds_the_same_samples(device):
    """But for those that rounding moves to another cell."""
    given = *rays(), 0.01
    found, expected = by_kernel(device, *given), reference.spheres(*given)
    same = np.diff(found.first) == np.diff(expected.first)
    assert same.mean() > 0.95
    for r in np.flatnonzero(same):
        own = slice(found.first[r], found.first[r + 1]), slice(expected.first[r], expected.first[r + 1])
        # Where a ray touches a sphere, the root of a difference has half of the digits.
        np.testing.assert_allclose(found.positions[own[0]], expected.positions[own[1]], atol=3e-4)
        np.testing.assert_allclose(found.deltas[own[0]], expected.deltas[own[1]], rtol=2e-3)


def test_samples_lie_on_their_rays_and_lengths_add_up(device64):
    """Positions are points of the ray beyond its start, and lengths those of the contracted ray to infinity."""
    origins, directions, offsets, _ = rays()
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)  # in double precision
    near = 0.3
    found = by_kernel(device64, origins, directions, offsets, np.ones((40, 3, 4), np.uint8), near)
    longitude, latitude, depth = found.positions.T * np.array([[2 * np.pi], [np.pi], [1]])
    radius, flat = 1 / (1 - depth), np.sin(latitude)
    unit = np.stack([-np.sin(longitude) * flat, np.cos(latitude), -np.cos(longitude) * flat], axis=1)
    apart = radius[:, None] * unit - origins[found.rays_of]
    along = (apart * directions[found.rays_of]).sum(axis=1)
    assert along.min() > near
    across = np.linalg.norm(apart - along[:, None] * directions[found.rays_of], axis=1)
    np.testing.assert_allclose(across, 0, atol=1e-9 * radius.max())
    t = np.geomspace(near, 1e6, 20000)
    for r, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        points = origin + t[:, None] * direction
        outside = np.linalg.norm(points, axis=1) > 1
        outside[t < -origin @ direction] = False  # before a ray comes nearest to the centre, it has no samples
        curve = np.linalg.norm(np.diff(contract(points[outside]), axis=0), axis=1).sum()
        length = found.deltas[found.first[r] : found.first[r + 1]].sum()
        assert length == pytest.approx(curve, rel=0.01)  # chords are shorter than the curve


def test_no_samples_are_one_that_no_ray_has(any_device):
    origins, directions, offsets, occupied = rays(share=0.0)
    arrays = [any_device.upload("rays", a) for a in (origins, directions, offsets)]
    samples = ops.spheres(any_device, *arrays, any_device.upload("occupied", occupied, np.uint8), 0.1)
    assert samples.total == 0 and not samples.first.get().any()
    for array in (samples.positions, samples.deltas, samples.rays_of):
        assert len(array) == 1 and not array.get().any()
