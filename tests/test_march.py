"""Stage march: steps in numbers, the contraction, empty cells, against the twin."""

import numpy as np
import pytest
from tolerances import DOUBLE

from clsplat import ops, reference
from clsplat.field_stages import Marching
from clsplat.reference.march import contract
from clsplat.testing import assert_matches

CUBE = Marching(step=0.03, cone=0.0, near=0.0, far=10.0, contracted=False)
SPACE = Marching(step=0.05, cone=0.04, near=0.02, far=200.0, contracted=True)


def rays(marching, count=60, cells=8, share=0.4):
    """Rays from around the field, along an axis and past the cube, and a grid of which `share` is occupied."""
    rng = np.random.default_rng(0)
    middle, radius = (0.0, 0.5) if marching.contracted else (0.5, 1.5)
    origins = middle + radius * rng.normal(size=(count, 3))
    directions = middle + rng.uniform(-0.4, 0.4, (count, 3)) - origins
    origins[0], directions[0] = [0.3, 0.4, -1], [0, 0, 1]
    origins[1], directions[1] = [3, 0.4, -1], [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    occupied = (rng.uniform(size=(cells,) * 3) < share).astype(np.uint8)
    arrays = (a.astype(np.float32).astype(np.float64) for a in (origins, directions, rng.uniform(size=count)))
    return [*arrays, occupied]


def by_kernel(device, origins, directions, offsets, occupied, marching):
    arrays = [device.upload("rays", a) for a in (origins, directions, offsets)]
    samples = ops.march(device, *arrays, device.upload("occupied", occupied, np.uint8), marching)
    kept = slice(0, samples.total)
    return samples._replace(**{k: getattr(samples, k).get()[kept] for k in ("positions", "deltas", "rays_of")},
                            first=samples.first.get())  # fmt: skip


def test_in_numbers(any_device):
    """A ray along z through a cube of one cell: steps of a quarter, the first at half a step."""
    given = np.array([[0.25, 0.5, -1.0]]), np.array([[0.0, 0, 1]]), np.array([0.5]), np.ones((1, 1, 1), np.uint8)
    march = Marching(0.25, 0.0, 0.0, 9.0, False)
    for samples in (reference.march(*given, march), by_kernel(any_device, *given, march)):
        np.testing.assert_array_equal(samples.positions, [[0.25, 0.5, z] for z in (0.125, 0.375, 0.625, 0.875)])
        np.testing.assert_array_equal(samples.deltas, [0.25] * 4)
        np.testing.assert_array_equal(samples.first, [0, 4])
        assert samples.total == 4


def test_a_ray_from_so_far_away_that_no_step_changes_it_ends(any_device):
    distance = 1e6 if any_device.real == np.float32 else 2.0**50
    given = np.array([[0.5, 0.5, -distance]]), np.array([[0.0, 0, 1]]), np.zeros(1), np.ones((1, 1, 1), np.uint8)
    march = Marching(1e-3, 0.0, 0.0, 2 * distance, False)
    assert by_kernel(any_device, *given, march).total == 1
    if any_device.real == np.float64:
        assert reference.march(*given, march).total == 1


def test_the_contraction_in_numbers():
    points = np.array([[0.5, 0, 0], [0, 1, 0], [0, 0, -4], [3e8, 0, 0]])
    np.testing.assert_allclose(contract(points), [[0.5, 0, 0], [0, 1, 0], [0, 0, -1.75], [2, 0, 0]])


@pytest.mark.parametrize("marching", [CUBE, SPACE], ids=["cube", "space"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.4, 1.0])
def test_matches_twin(device64, marching, share):
    """In double precision the same samples; empty cells are left as the twin steps through them."""
    given = rays(marching, share=share)
    found, expected = by_kernel(device64, *given, marching), reference.march(*given, marching)
    assert expected.total == (0 if share == 0 else expected.total) and (share < 0.4 or expected.total > 500)
    np.testing.assert_array_equal(found.first, expected.first)
    np.testing.assert_array_equal(found.rays_of, expected.rays_of)
    assert_matches("positions", found.positions, expected.positions, DOUBLE)
    assert_matches("deltas", found.deltas, expected.deltas, DOUBLE)


@pytest.mark.parametrize("marching", [CUBE, SPACE], ids=["cube", "space"])
def test_single_precision_finds_the_same_samples(device, marching):
    """But for those that rounding moves to another cell: few, and of both kinds."""
    given = rays(marching)
    found, expected = by_kernel(device, *given, marching), reference.march(*given, marching)
    assert abs(found.total - expected.total) < 0.01 * expected.total
    same = np.diff(found.first) == np.diff(expected.first)
    assert same.mean() > 0.8
    for r in np.flatnonzero(same):
        own = slice(found.first[r], found.first[r + 1]), slice(expected.first[r], expected.first[r + 1])
        # A sum of up to 300 steps, each rounded.
        np.testing.assert_allclose(found.positions[own[0]], expected.positions[own[1]], atol=2e-5)


def test_no_samples_are_one_that_no_ray_has(any_device):
    """Other stages may read it: it has a position, and the index of a ray."""
    origins, directions, offsets, occupied = rays(CUBE, share=0.0)
    arrays = [any_device.upload("rays", a) for a in (origins, directions, offsets)]
    samples = ops.march(any_device, *arrays, any_device.upload("occupied", occupied, np.uint8), CUBE)
    assert samples.total == 0 and not samples.first.get().any()
    for array in (samples.positions, samples.deltas, samples.rays_of):
        assert len(array) == 1 and not array.get().any()


def test_lengths_are_those_of_the_contracted_ray(device64):
    """They add up to the length of the curve that the contraction makes of the ray, less than 4 for any ray."""
    origins, directions, offsets, _ = rays(SPACE)
    found = by_kernel(device64, origins, directions, 0 * offsets, np.ones((8, 8, 8), np.uint8), SPACE)
    assert (found.positions >= 0).all() and (found.positions <= 1).all()
    t = np.geomspace(SPACE.near, SPACE.far, 4000)
    curves = contract(origins[:, None] + t[:, None] * directions[:, None])
    expected = np.linalg.norm(np.diff(curves, axis=1), axis=2).sum(axis=1)
    lengths = np.add.reduceat(found.deltas, found.first[:-1].astype(int))
    # Chords are shorter than the curve, and the last step ends behind `far`.
    np.testing.assert_allclose(lengths, expected, rtol=0.01)
    assert expected.max() < 4


def test_steps_are_equal_far_away(device64):
    """A ray from the origin: steps of `cone` in contracted space, so that few samples lie where little is seen."""
    given = np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.zeros(1), np.ones((1, 1, 1), np.uint8)
    found = by_kernel(device64, *given, Marching(step=0.01, cone=0.02, near=1.0, far=1e4, contracted=True))
    near = found.deltas[found.positions[:, 2] < 0.9]  # up to t = 2.5: 1/t falls by cone / (1 + cone t) in a step
    assert ((near < 0.02) & (near > 0.018)).all() and len(near) > 25
    assert found.total < 90
