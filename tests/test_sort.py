"""Stage sort: both algorithms against a stable argsort of NumPy, in the configurations of CPUs and GPUs."""

import numpy as np
import pytest

from clsplat import ops, reference
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.ops import sort
from clsplat.ops.sort import BITONIC_MAX, CPU_SHORT_SEGMENT

# Around runs of 8 keys, work-groups of 64 and 128, the bitonic sort's capacity, and chunks of 128 x 8 keys.
SIZES = [1, 2, 7, 8, 9, 63, 64, 65, 127, 129, 1023, 1024, 1025, 4097, 100_000]
WIDTHS = {32: np.uint32, 64: np.uint64}


def keys_of(kind, n, bits, dtype):
    """Random keys of `bits` bits; few distinct ones; one; all bits set; sorted backwards."""
    rng = np.random.default_rng(n)
    largest = 2**bits - 1
    keys = {
        "random": lambda: rng.integers(0, largest, n, dtype=np.uint64, endpoint=True),
        "few": lambda: rng.integers(0, largest, 3, dtype=np.uint64)[rng.integers(0, 3, n)],
        "equal": lambda: np.full(n, largest // 3),
        "largest": lambda: np.full(n, largest, dtype=np.uint64),
        "backwards": lambda: np.arange(n, 0, -1),
    }
    return keys[kind]().astype(dtype)


def check(device, keys, bits, method):
    array = device.upload("keys", keys, keys.dtype)
    payload = np.random.default_rng(1).integers(0, 2**32, len(keys), dtype=np.uint32)
    on_device = device.upload("values", payload, np.uint32)
    for values, values_on_device in ((None, None), (payload, on_device)):
        result = ops.argsort(device, array, bits, method, values=values_on_device)
        sorted_keys, order = (a.get() for a in result)
        expected_keys, expected_order = reference.argsort(keys, bits, values=values)
        assert sorted_keys.dtype == keys.dtype and order.dtype == np.uint32
        np.testing.assert_array_equal(order, expected_order)
        np.testing.assert_array_equal(sorted_keys, expected_keys)
    np.testing.assert_array_equal(array.get(), keys, err_msg="the keys were changed")
    np.testing.assert_array_equal(on_device.get(), payload, err_msg="the values were changed")


@pytest.mark.parametrize("kind", ["random", "few", "equal", "largest", "backwards"])
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("n", SIZES)
def test_radix(configured_device, n, width, kind):
    check(configured_device, keys_of(kind, n, width, WIDTHS[width]), width, "radix")


@pytest.mark.parametrize("n", [7 * 1024 - 1, 7 * 1024 + 1, 9 * 1024])
def test_blocks_of_several_chunks(monkeypatch, n):
    """Of which the last block has fewer than the others, or none."""
    monkeypatch.setenv("CLSPLAT_VARIANTS", "gpu")
    monkeypatch.setattr(sort, "RADIX_GROUPS", 4)
    for kind in ("random", "few", "largest"):
        check(Device(), keys_of(kind, n, 32, np.uint32), 32, "radix")


@pytest.mark.parametrize("kind", ["random", "few", "equal", "largest", "backwards"])
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("n", [n for n in SIZES if n <= BITONIC_MAX])
def test_bitonic(configured_device, n, width, kind):
    check(configured_device, keys_of(kind, n, width, WIDTHS[width]), width, "bitonic")


@pytest.mark.parametrize("n", [BITONIC_MAX, BITONIC_MAX + 1])
def test_automatic_choice(device, n):
    check(device, keys_of("few", n, 32, np.uint32), 32, "auto")


def test_too_many_for_a_bitonic_sort(device):
    keys = device.upload("keys", np.zeros(BITONIC_MAX + 1), np.uint32)
    with pytest.raises(InputError, match="keys: expected at most 1024 for a bitonic sort, found 1025"):
        ops.argsort(device, keys, 32, "bitonic")


@pytest.mark.parametrize("bits", [1, 4, 5, 11, 12, 23])
def test_few_bits(configured_device, bits):
    check(configured_device, keys_of("random", 3000, bits, np.uint32), bits, "radix")


# Nothing, both sides of the longest segment that either device gives to the bitonic sort, and of runs per work-item.
LENGTHS = [0, 1, 2, 3, CPU_SHORT_SEGMENT, CPU_SHORT_SEGMENT + 1, 0, 255, BITONIC_MAX, BITONIC_MAX + 1, 5000]


@pytest.mark.parametrize("kind", ["random", "few", "equal", "largest", "backwards"])
@pytest.mark.parametrize("bits", [1, 9, 31, 32, 63, 64])
def test_segments(configured_device, bits, kind):
    """In an order that is not that of memory, with entries before, between and after them that are no one's."""
    rng = np.random.default_rng(bits)
    lengths = rng.permutation(LENGTHS)
    ends = np.cumsum(lengths + 5)
    ranges = rng.permutation(np.stack([ends - lengths, ends], axis=1)).astype(np.uint32)
    n = ends[-1] + 5
    keys = keys_of(kind, n, bits, np.uint32 if bits <= 32 else np.uint64) & np.uint64(2**bits - 1)
    keys = keys.astype(np.uint32 if bits <= 32 else np.uint64)
    payload = rng.integers(0, 2**32, n, dtype=np.uint32)
    arrays = [configured_device.upload("keys", a, a.dtype) for a in (keys, ranges, payload)]
    inside = np.concatenate([np.arange(begin, end) for begin, end in ranges])
    for values, values_on_device in ((None, None), (payload, arrays[2])):
        order = ops.argsort_segments(configured_device, arrays[0], bits, arrays[1], values_on_device).get()
        expected = reference.argsort_segments(keys, bits, ranges, values)
        np.testing.assert_array_equal(order[inside], expected[inside])
    for array, host in zip(arrays, (keys, ranges, payload), strict=True):
        np.testing.assert_array_equal(array.get(), host, err_msg="an input was changed")


def test_twin_is_numpy():
    keys = keys_of("few", 1000, 32, np.uint32)
    np.testing.assert_array_equal(reference.argsort(keys, 32)[1], np.argsort(keys, kind="stable"))
    # By (segment, key) is the same as within segments.
    ranges = np.array([[0, 400], [400, 400], [400, 1000]], np.uint32)
    expected = np.lexsort([keys, np.arange(1000) >= 400])
    np.testing.assert_array_equal(reference.argsort_segments(keys, 32, ranges), expected)
