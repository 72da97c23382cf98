"""Stage take: the kernel against the twin, to the bit."""

import numpy as np
import pytest

from clsplat import ops, reference


@pytest.mark.parametrize("m", [1, 63, 400])
@pytest.mark.parametrize("shape", [(), (3,), (15, 3)])
def test_matches_twin(any_device, shape, m):
    """Rows of one value and of many; repeated, left out, in any order, and 0."""
    rng = np.random.default_rng(m)
    array = rng.normal(size=(100, *shape)).astype(any_device.real)
    rows = rng.integers(-1, 100, m)
    rows[0] = 99
    uploaded = any_device.upload("array", array), any_device.upload("rows", rows, np.int32)
    found = ops.take_rows(any_device, *uploaded).get()
    expected = reference.take_rows(array, rows)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(expected[0], array[99])
    assert not expected[rows < 0].any()
    np.testing.assert_array_equal(expected[rows >= 0], array[rows[rows >= 0]])
