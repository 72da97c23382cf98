"""Stage finite: each kind of number, and the kernel against the twin."""

import numpy as np
import pytest

from clsplat import ops, reference


def test_in_numbers(any_device):
    """The largest and the smallest numbers of either sign are finite, denormal ones too."""
    info = np.finfo(any_device.real)
    finite = [0.0, -0.0, 1.0, info.max, -info.max, info.tiny, -info.tiny, info.smallest_subnormal]
    for others in ([], [np.nan], [np.inf, -np.inf], [-np.nan, np.inf, np.nan]):
        values = np.array([*finite, *others], any_device.real)
        assert reference.count_not_finite(values) == len(others)
        assert ops.count_not_finite(any_device, any_device.upload("values", values)) == len(others)


@pytest.mark.parametrize("shape", [(1,), (63,), (65, 3), (1000, 16, 3)])
@pytest.mark.parametrize("share", [0, 0.1, 1])
def test_matches_twin(any_device, shape, share):
    rng = np.random.default_rng(0)
    values = rng.normal(size=shape).astype(any_device.real)
    chosen = rng.random(shape) < share
    values[chosen] = rng.choice([np.nan, np.inf, -np.inf], np.count_nonzero(chosen))
    expected = reference.count_not_finite(values)
    assert expected == np.count_nonzero(chosen)
    assert ops.count_not_finite(any_device, any_device.upload("values", values)) == expected


def test_values_of_an_earlier_array_do_not_count(any_device):
    """Buffers are reused: what lies behind the end of an array is not its own."""
    any_device.upload("values", np.full(64, np.nan))
    assert ops.count_not_finite(any_device, any_device.upload("values", np.zeros(33))) == 0
