"""Stage intervals: places in numbers, the distribution of draws, against the twin, and the same bits."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.field_stages import Span
from clsplat.testing import assert_matches

CUBE, SPACE = Span(0.0, 1e6, False), Span(0.05, 100.0, True)


def exact(*arrays):
    return [a.astype(np.float32).astype(np.float64) for a in arrays]


def rays(span, count=40, intervals=24):
    """Rays from around the field, one along an axis and one beside the cube; their edges and offsets."""
    rng = np.random.default_rng(0)
    middle, radius = (0.0, 0.5) if span.contracted else (0.5, 1.5)
    origins = middle + radius * rng.normal(size=(count, 3))
    directions = middle + rng.uniform(-0.4, 0.4, (count, 3)) - origins
    origins[:2], directions[:2] = [[0.3, 0.4, -1], [3, 0.4, -1]], [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    edges = np.sort(rng.uniform(size=(count, intervals + 1)), axis=1)
    return exact(origins, directions, edges, rng.uniform(size=(count, intervals)))


def along(device, origins, directions, edges, offsets, span):
    arrays = [device.upload("array", a) for a in (origins, directions, edges, offsets)]
    return [a.get() for a in ops.intervals_along(device, *arrays, span)]


def resample(device, edges, weights, draws, *how):
    arrays = [device.upload("array", a) for a in (edges, weights, draws)]
    return ops.intervals_resample(device, *arrays, *how).get()


def test_samples_in_numbers(any_device):
    """A ray along z through the cube in two halves; and one from 0.1 to 10, contracted distances 0.1, 1 and 1.9."""
    ray = np.array([[0.25, 0.5, -1.0]]), np.array([[0.0, 0, 1]])
    edges, offsets = np.array([[0, 0.5, 1]]), np.array([[0.5, 0.0]])
    for points, deltas in (
        reference.intervals_along(*ray, edges, offsets, CUBE),
        along(any_device, *ray, edges, offsets, CUBE),
    ):
        np.testing.assert_allclose(points, [[-0.5, 0, -0.5], [-0.5, 0, 0]], atol=1e-6)
        np.testing.assert_allclose(deltas, [0.5, 0.5], rtol=1e-6)
    ray = np.zeros((1, 3)), np.array([[0.0, 0, 1]])
    for points, deltas in (
        reference.intervals_along(*ray, edges, 0 * offsets, Span(0.1, 10.0, True)),
        along(any_device, *ray, edges, 0 * offsets, Span(0.1, 10.0, True)),
    ):
        np.testing.assert_allclose(points[:, 2], [0.05, 0.5], rtol=1e-6)
        np.testing.assert_allclose(deltas, [0.9, 9], rtol=1e-6)


def test_draws_in_numbers(any_device):
    """Weights 1, 0 and 3 of edges 0, 0.2, 0.4 and 1: the middles of the quarters of the distribution."""
    given = np.array([[0, 0.2, 0.4, 1]]), np.array([1.0, 0, 3]), np.full((1, 4), 0.5)
    kernel = lambda *a: resample(any_device, *a)  # noqa: E731
    for run in (reference.intervals_resample, kernel):
        np.testing.assert_allclose(run(*given, 1e-9, 1.0, False), [[0.1, 0.5, 0.7, 0.9]], atol=1e-6)
        merged = run(*given, 1e-9, 1.0, True)
        np.testing.assert_allclose(merged, [[0, 0.1, 0.2, 0.4, 0.5, 0.7, 0.9, 1]], atol=1e-6)
        # All intervals have the same share, whatever their lengths: 3/8, 9/8, 15/8 and 21/8 of three.
        np.testing.assert_allclose(run(*given, 1.0, 0.0, False), [[0.075, 0.225, 0.375, 0.775]], atol=1e-6)


@pytest.mark.parametrize("span", [CUBE, SPACE], ids=["cube", "space"])
def test_samples_match_twin(any_device, span):
    given = rays(span)
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    points, deltas = reference.intervals_along(*given, span)
    assert span.contracted or not deltas[24:48].any()  # beside the cube
    found = along(any_device, *given, span)
    assert_matches("points", found[0], points, tolerances)
    assert_matches("lengths", found[1], deltas, tolerances)
    assert np.abs(found[0]).max() <= 1 + 1e-6 or not span.contracted


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize(("padding", "power"), [(1e-5, 1.0), (0.01, 0.4)])
def test_draws_match_twin(any_device, keep, padding, power):
    rng = np.random.default_rng(3)
    edges = rays(CUBE)[2]
    weights, draws = exact(rng.uniform(size=24 * 40) ** 4, rng.uniform(size=(40, 50)))
    expected = reference.intervals_resample(edges, weights, draws, padding, power, keep)
    found = resample(any_device, edges, weights, draws, padding, power, keep)
    assert (np.diff(found, axis=1) >= 0).all() and found.shape == (40, 75 if keep else 50)
    assert_matches("edges", found, expected, DOUBLE if any_device.real == np.float64 else FLOAT)


def test_draws_have_the_distribution_of_the_weights(device64):
    """Many draws: the share between two edges is that of the weight."""
    edges, weights = np.array([[0, 0.1, 0.5, 0.9, 1]]), np.array([1.0, 2, 3, 4])
    draws = np.random.default_rng(0).uniform(size=(1, 10000))
    found = resample(device64, edges, weights, draws, 1e-9, 1.0, False)
    counts, _ = np.histogram(found, edges[0])
    np.testing.assert_allclose(counts, [1000, 2000, 3000, 4000], atol=1)  # stratified


def test_degenerate_weights_leave_draws_between_the_edges(any_device):
    """No weight at all, or one that is far above the others; draws at both ends."""
    edges = np.tile(np.linspace(0, 1, 9), (3, 1))
    weights, draws = np.zeros((3, 8)), np.tile(np.nextafter(1, 0, dtype=np.float32), (3, 6))
    weights[1, 7], weights[2, 0], draws[2] = 1e30, 1e30, 0
    found = resample(any_device, edges, weights.ravel(), draws, 1e-5, 1.0, False)
    assert (found >= 0).all() and (found <= 1).all() and (np.diff(found, axis=1) >= 0).all()
    assert found[1].min() >= 0.875 and found[2].max() <= 0.125


def test_draws_repeat_to_the_bit(device):
    edges = rays(CUBE)[2]
    rng = np.random.default_rng(4)
    given = edges, rng.uniform(size=24 * 40), rng.uniform(size=(40, 50)), 1e-5, 1.0, True
    first = resample(device, *given)
    for _ in range(3):
        np.testing.assert_array_equal(resample(device, *given), first)
