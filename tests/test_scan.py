"""Stage scan: exact against the twin for every number of chunks, and the total that 32 bits cannot hold."""

import numpy as np
import pytest

from clsplat import ops, reference
from clsplat.errors import DeviceError

# Around the chunks' borders: a GPU's configuration has 8192 chunks, a CPU's a few per core.
SIZES = [1, 2, 7, 8, 9, 63, 64, 65, 1000, 8191, 8192, 8193, 16385, 100_003]


@pytest.mark.parametrize("n", SIZES)
def test_matches_twin(configured_device, n):
    values = np.random.default_rng(n).integers(0, 1000, n).astype(np.uint32)
    values[n // 3 : n // 2] = 0
    sums, total = ops.exclusive_scan(configured_device, configured_device.upload("values", values, np.uint32))
    expected, expected_total = reference.exclusive_scan(values)
    assert total == expected_total == values.sum()
    np.testing.assert_array_equal(sums.get(), expected)


def test_values_stay(configured_device):
    values = np.arange(5000, dtype=np.uint32)
    array = configured_device.upload("values", values, np.uint32)
    ops.exclusive_scan(configured_device, array)
    np.testing.assert_array_equal(array.get(), values)


def test_largest_total(configured_device):
    values = np.full(65537, 65535, np.uint32)  # 65537 * 65535 = 2^32 - 1
    sums, total = ops.exclusive_scan(configured_device, configured_device.upload("values", values, np.uint32))
    assert total == 2**32 - 1
    assert sums.get()[-1] == 2**32 - 1


@pytest.mark.parametrize("values", [[2**31, 2**31], [65536] * 65536, [2**32 - 1, 0, 0, 1]], ids=len)
def test_overflow_is_an_error(configured_device, values):
    values = np.array(values, np.uint32)
    total = int(values.sum(dtype=np.uint64))
    array = configured_device.upload("values", values, np.uint32)
    with pytest.raises(DeviceError, match=f"intersections: expected a total below .* found {total}; use fewer"):
        ops.exclusive_scan(configured_device, array, "intersections")
    with pytest.raises(OverflowError, match=str(total)):
        reference.exclusive_scan(values)
