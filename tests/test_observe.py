"""Stage observe: numbers worked out by hand, and the kernel against the twin."""

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
