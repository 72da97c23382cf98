"""Stage frustums: moments against sums over the cone, the contraction's derivative, and against the twin."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.field_stages import FRUSTUM_AXES, Span, frustum_width
from clsplat.reference.frustums import contraction_jacobians, gaussians_of
from clsplat.reference.march import contract
from clsplat.testing import assert_matches

CUBE, SPACE = Span(0.0, 1e6, False), Span(0.05, 100.0, True)


def rays(span, count=20, intervals=7):
    rng = np.random.default_rng(0)
    middle, radius = (0.0, 0.5) if span.contracted else (0.5, 1.5)
    origins = middle + radius * rng.normal(size=(count, 3))
    directions = middle + rng.uniform(-0.4, 0.4, (count, 3)) - origins
    origins[:2], directions[:2] = [[0.3, 0.4, -1], [3, 0.4, -1]], [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    edges = np.sort(rng.uniform(size=(count, intervals + 1)), axis=1)
    edges[:, 3] = edges[:, 2]  # an interval without length
    arrays = origins, directions, rng.uniform(0.001, 0.02, count), edges
    return [a.astype(np.float32).astype(np.float64) for a in arrays]


def by_kernel(device, origins, directions, radii, edges, span, levels):
    arrays = [device.upload("array", a) for a in (origins, directions, radii, edges)]
    return [a.get() for a in ops.frustums_encode(device, *arrays, span, levels)]


def test_the_axes_are_21_of_an_icosahedron():
    """6 axes through corners and 15 through edges: no two parallel; as spread as possible, so the same every way."""
    axes = np.array(FRUSTUM_AXES)
    assert axes.shape == (21, 3) and frustum_width(12) == 512
    assert np.abs(axes @ axes.T - np.eye(21)).max() < 0.86
    np.testing.assert_allclose(axes.T @ axes, 7 * np.eye(3), atol=1e-12)


def test_moments_are_those_of_a_cone():
    """Mean and variances of points in a cone from 1 to 3, by a sum over slices whose areas grow as t^2."""
    t, rho = np.array([[1.0, 3.0]]), 0.1
    mean, covariance = gaussians_of(np.zeros((1, 3)), np.array([[0.0, 0, 1]]), np.array([rho]), t)
    z = np.linspace(1, 3, 200001)
    share = z**2 / (z**2).sum()
    np.testing.assert_allclose(mean[0, 0], [0, 0, share @ z], rtol=1e-4)  # the sum's own error: 1e-5
    along = share @ z**2 - (share @ z) ** 2
    across = rho**2 / 4 * (share @ z**2)  # a disc of radius r has the variance r^2/4 in each direction
    np.testing.assert_allclose(covariance[0, 0], np.diag([across, across, along]), rtol=1e-4, atol=1e-12)


def test_the_derivative_of_the_contraction():
    x = np.random.default_rng(1).normal(size=(50, 3)) * np.repeat([0.3, 3.0], 25)[:, None]
    x[0] = [0.2, 0.3, 0.1]
    steps = 1e-6 * np.eye(3)
    found = np.stack([(contract(x + step) - contract(x - step)) / 2e-6 for step in steps], axis=-1)
    np.testing.assert_allclose(contraction_jacobians(x), found, atol=1e-8)  # differences of 1e-6: rounding 1e-10


def test_small_frustums_have_the_sines_of_their_place(any_device):
    """Without a radius and a length, features are sines and cosines of the point; with them, they fade."""
    given = np.full((2, 3), 0.5), np.array([[0.0, 0, 1], [0, 0, 1]]), np.array([0.0, 3.0]), np.array([[0.5, 0.5]] * 2)
    point = np.array([0, 0, 0.5])  # half of the way from the middle of the cube to its face at 1, times 2
    for encoded, deltas in (
        reference.frustums_encode(*given, CUBE, 3),
        by_kernel(any_device, *given, CUBE, 3),
    ):
        angles = 2.0 ** np.arange(3)[:, None] * (np.array(FRUSTUM_AXES) @ point)
        expected = np.stack([np.sin(angles), np.cos(angles)], axis=-1).ravel()
        np.testing.assert_allclose(encoded[0, :126], expected, atol=1e-6)  # float32
        assert encoded[0, 126] == 1 and not encoded[0, 127:].any()
        # The first axis is that of the ray, which has no extent along itself.
        assert np.abs(encoded[1, 86:126]).max() < 0.9 and not deltas.any()


@pytest.mark.parametrize("span", [CUBE, SPACE], ids=["cube", "space"])
@pytest.mark.parametrize("levels", [4, 12])
def test_matches_twin(any_device, span, levels):
    check(any_device, span, levels)


@pytest.mark.parametrize("span", [CUBE, SPACE], ids=["cube", "space"])
def test_matches_twin_as_cpu_and_gpu(configured_device, span):
    check(configured_device, span, 5)


def test_encodings_repeat_to_the_bit(configured_device):
    given = *rays(SPACE), SPACE, 8
    first = by_kernel(configured_device, *given)
    for before, again in zip(first, by_kernel(configured_device, *given), strict=True):
        np.testing.assert_array_equal(again, before)


def check(device, span, levels):
    given = rays(span)
    encoded, deltas = reference.frustums_encode(*given, span, levels)
    assert span.contracted or not deltas[7:14].any()  # beside the cube
    found = by_kernel(device, *given, span, levels)
    tolerances = DOUBLE if device.real == np.float64 else FLOAT
    assert_matches("integrated encoding", found[0], encoded, tolerances)
    assert_matches("lengths", found[1], deltas, tolerances)
