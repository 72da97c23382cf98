"""Stage observe: numbers worked out by hand, and the kernels against the twin."""

import math

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.testing import assert_matches


def by_kernel(device, extents, v_means2d, width, height, grad_sum, seen):
    extents, v_means2d, grad_sum = (device.upload("a", a) for a in (extents, v_means2d, grad_sum))
    counts = device.upload("seen", seen, np.int32)
    ops.observe(device, extents, v_means2d, width, height, grad_sum, counts)
    return grad_sum.get(), counts.get()


def test_in_numbers(any_device):
    """3-4-5 in units of half the image; what is not visible stays, whatever its gradient says."""
    extents = np.array([[2.0, 1.0], [0.0, 0.0], [1.0, 1.0]])
    v_means2d = np.array([[3.0, 2.0], [np.nan, 1.0], [0.0, 0.0]])
    before = np.array([1.0, 2.0, 3.0]), np.array([4, 5, 6], np.int32)
    expected = [1 + 2 * 5, 2, 3], [5, 5, 7]
    twin = [a.copy() for a in before]
    reference.observe(extents, v_means2d, 4, 8, *twin)
    for grad_sum, seen in (twin, by_kernel(any_device, extents, v_means2d, 4, 8, *before)):
        np.testing.assert_array_equal(grad_sum, expected[0])
        np.testing.assert_array_equal(seen, expected[1])


@pytest.mark.parametrize("n", [1, 63, 64, 65, 1000])
def test_matches_twin(any_device, n):
    rng = np.random.default_rng(n)
    extents = rng.uniform(0, 9, (n, 2)) * (rng.random((n, 1)) < 0.5)
    v_means2d = rng.normal(size=(n, 2)).astype(np.float32).astype(np.float64)
    grad_sum, seen = rng.uniform(0, 1, n).astype(np.float32), rng.integers(0, 100, n).astype(np.int32)
    found = by_kernel(any_device, extents, v_means2d, 640, 333, grad_sum, seen)
    expected = grad_sum.astype(np.float64), seen.copy()
    reference.observe(extents, v_means2d, 640, 333, *expected)
    assert_matches("grad_sum", found[0], expected[0], DOUBLE if any_device.real == np.float64 else FLOAT)
    np.testing.assert_array_equal(found[1], expected[1])


@pytest.mark.parametrize("n", [1, 64, 1000])
def test_columns_are_added_with_twice_the_digits(any_device, n):
    """Of sums that cancel, far more is left than the rounding of a real leaves; later rows do not count."""
    rng = np.random.default_rng(n)
    terms = (rng.normal(size=(10, n + 3, 4)) * 10 ** rng.uniform(-3, 3, (10, n + 3, 4))).astype(any_device.real)
    terms[9] = -terms[:9].sum(axis=0)  # up to rounding
    sums, twin = any_device.zeros("sums", (n, 2)), np.zeros((n, 2))
    for values in terms:
        ops.add_column(any_device, any_device.upload("values", values), 2, sums)
        reference.add_column(values.astype(np.float64), 2, twin)
    exact = np.array([math.fsum(column) for column in terms[:, :n, 2].T.astype(np.float64)])
    scale = np.abs(terms[:, :n, 2]).max(axis=0).astype(np.float64)
    assert n == 1 or (np.abs(exact) > 0.01 * np.finfo(any_device.real).eps * scale).any()
    high, low = sums.get().astype(np.float64).T
    # Ten additions; in the sum of their errors, each rounds by at most half an eps of eps.
    atol = 20 * np.finfo(any_device.real).eps ** 2
    np.testing.assert_array_less(
        np.abs([math.fsum(pair) for pair in zip(high, low, -exact, strict=True)]), atol * scale
    )
    np.testing.assert_array_less(np.abs(twin.sum(axis=1) - exact), 20 * np.finfo(np.float64).eps * scale)


def test_a_factor_for_each_photo(any_device):
    """An exact one, and one whose products are rounded."""
    rng = np.random.default_rng(0)
    sums, twin = any_device.zeros("sums", (100, 2)), np.zeros((100, 2))
    for factor in (0.5, 1 / 3):
        values = rng.uniform(1, 2, (100, 5)).astype(np.float32)
        ops.add_column(any_device, any_device.upload("values", values), 4, sums, factor)
        reference.add_column(values.astype(np.float64), 4, twin, factor)
    found = sums.get().astype(np.float64).sum(axis=1)
    np.testing.assert_allclose(found, twin.sum(axis=1), rtol=2 * np.finfo(any_device.real).eps)
