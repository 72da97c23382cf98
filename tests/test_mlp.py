"""Stage mlp: in numbers, against the twin and central differences, and the same bits."""

from itertools import pairwise

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.errors import InputError
from clsplat.testing import assert_matches, gradcheck

# Instant-NGP's networks, one layer alone, widths that are odd multiples of 16, and the widest
# inputs of NeRF and Mip-NeRF 360.
WIDTHS = [(32, 64, 16), (32, 64, 64, 16), (16, 16), (48, 256, 16, 80, 48), (320, 16), (1536, 16, 32)]
# Less than a block of rows, a part of the last block, less and more than a chunk, and than the bands of all cores.
ROWS = [1, 13, 96, 1000]


def inputs(rows, widths):
    rng = np.random.default_rng(rows)
    count = sum(a * b for a, b in pairwise(widths))
    arrays = rng.normal(size=(rows, widths[0])), rng.normal(size=count) / 4, rng.normal(size=(rows, widths[-1]))
    return [a.astype(np.float32).astype(np.float64) for a in arrays]


def by_kernel(device, widths, x, weights, v):
    x, w = device.upload("x", x), device.upload("weights", weights)
    outputs, hidden = ops.mlp_fwd(device, x, w, widths)
    v_x, v_w = ops.mlp_bwd(device, x, w, widths, hidden, device.upload("v", v), widths[0])
    return outputs.get(), v_x.get(), v_w.get()


def by_twin(widths, x, weights, v):
    outputs, hidden = reference.mlp_fwd(x, weights, widths)
    return outputs, *reference.mlp_bwd(x, weights, widths, hidden, v, widths[0])


def test_in_numbers(any_device):
    """Two hidden values, one of which is negative: it is 0, and nothing flows back through it."""
    widths = (16, 16, 16)
    x, first, second, v = np.zeros((1, 16)), np.zeros((16, 16)), np.zeros((16, 16)), np.zeros((1, 16))
    x[0, :2], first[0, :2], first[1, :2], second[:2, 3], v[0, 3] = [2, 1], [1, -3], [1, 1], [5, 7], 1
    weights = np.concatenate([first.ravel(), second.ravel()])
    for outputs, v_x, v_w in (by_twin(widths, x, weights, v), by_kernel(any_device, widths, x, weights, v)):
        assert outputs[0, 3] == 5 * 3 and outputs.sum() == 15
        np.testing.assert_array_equal(v_x[0, :2], [5, 5])
        v_first, v_second = v_w.reshape(2, 16, 16)
        assert v_second[0, 3] == 3 and v_second.sum() == 3
        np.testing.assert_array_equal(v_first[:2, :2], [[10, 0], [5, 0]])


@pytest.mark.parametrize("widths", WIDTHS, ids=str)
@pytest.mark.parametrize("rows", ROWS)
def test_matches_twin(any_device, rows, widths):
    check(any_device, rows, widths)


@pytest.mark.parametrize("widths", WIDTHS[1::2], ids=str)
@pytest.mark.parametrize("rows", ROWS)
def test_matches_twin_as_cpu_and_gpu(configured_device, rows, widths):
    check(configured_device, rows, widths)


def test_matches_twin_with_wide_registers(device, monkeypatch):
    monkeypatch.setattr(type(device), "vector_width", 16)
    check(device, 101, WIDTHS[1])


def check(device, rows, widths):
    given = inputs(rows, widths)
    tolerances = DOUBLE if device.real == np.float64 else FLOAT
    for name, found, expected in zip(
        ("outputs", "v_inputs", "v_weights"), by_kernel(device, widths, *given), by_twin(widths, *given), strict=True
    ):
        assert_matches(name, found, expected, tolerances)


def test_gradients_by_central_differences(device64):
    widths = (16, 32, 32, 16)
    x, weights, v = inputs(7, widths)
    # No hidden value is so close to 0 that a step of the differences, 1e-6, changes its sign.
    hidden = x @ weights[: 16 * 32].reshape(16, 32)
    assert min(np.abs(hidden).min(), np.abs(np.maximum(hidden, 0) @ weights[512:1536].reshape(32, 32)).min()) > 1e-4
    _, v_x, v_w = by_kernel(device64, widths, x, weights, v)
    gradcheck(
        lambda x, weights: float((by_kernel(device64, widths, x, weights, v)[0] * v).sum()),
        {"x": x, "weights": weights},
        {"x": v_x, "weights": v_w},
    )


@pytest.mark.parametrize("columns", [0, 16, 48])
def test_some_inputs_alone_and_a_sum_of_gradients(configured_device, columns):
    """The first columns of the inputs' gradient are the same bits; that of the weights is added to another one."""
    device, widths = configured_device, WIDTHS[3]
    x, weights, v = inputs(101, widths)
    _, whole, v_weights = by_kernel(device, widths, x, weights, v)
    on_device = device.upload("x", x), device.upload("weights", weights), widths
    hidden, before = ops.mlp_fwd(*(device, *on_device))[1], np.arange(weights.size) % 7.0
    given = *on_device, hidden, device.upload("v", v), columns, device.upload("before", before)
    v_x, total = (array.get() for array in ops.mlp_bwd(device, *given))
    assert columns == 0 or v_x.shape == (101, columns)
    np.testing.assert_array_equal(v_x.reshape(-1)[: 101 * columns], whole[:, :columns].ravel())
    # The sum begins with the other gradient, so that its rounding differs.
    np.testing.assert_allclose(total, before + v_weights, rtol=1e-5, atol=1e-4)
    hidden = reference.mlp_fwd(x, weights, widths)[1]
    v_x, again = reference.mlp_bwd(x, weights, widths, hidden, v, columns, before.copy())
    assert v_x.shape == (101, columns)
    np.testing.assert_allclose(total, again, rtol=1e-4, atol=1e-3)


def test_gradients_repeat_to_the_bit(configured_device):
    given = inputs(2000, WIDTHS[0])
    first = by_kernel(configured_device, WIDTHS[0], *given)
    for _ in range(3):
        for before, again in zip(first, by_kernel(configured_device, WIDTHS[0], *given), strict=True):
            np.testing.assert_array_equal(again, before)


@pytest.mark.parametrize("widths", [(32,), (32, 20), (32, 2064), (0, 16)])
def test_widths_out_of_range_are_refused(device, widths):
    with pytest.raises(InputError, match="expected two or more multiples of 16 up to 2048"):
        ops.mlp_fwd(device, device.empty("x", (1, 32)), device.empty("w", 16), widths)
