"""Stage encode: sines in numbers, against the twin and central differences."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.field_stages import encoded_width
from clsplat.testing import assert_matches, gradcheck


def exact(*arrays):
    return [a.astype(np.float32).astype(np.float64) for a in arrays]


def test_in_numbers(any_device):
    """Half a turn and a turn of 1/2; a quarter and a half of 1/4; 1, and zeros."""
    points = np.array([[0.5, 0.25, 0.0]])
    expected = [0.5, 0.25, 0, 1, 0.5**0.5, 0, 0, 0.5**0.5, 1, 0, 1, 0, -1, 0, 1, 1]
    kernel = ops.encode_points(any_device, any_device.upload("points", points), 2).get()
    for found in (reference.encode_points(points, 2), kernel):
        np.testing.assert_allclose(found, [expected], atol=1e-6)  # rounding of float32


@pytest.mark.parametrize(("levels", "width"), [(0, 16), (2, 16), (4, 32), (10, 64)])
def test_points_match_twin(any_device, levels, width):
    points = exact(np.random.default_rng(0).uniform(-1, 1, (301, 3)))[0]
    assert encoded_width(levels) == width
    expected = reference.encode_points(points, levels)
    assert expected.shape == (301, width) and (expected[:, 3 + 6 * levels] == 1).all()
    found = ops.encode_points(any_device, any_device.upload("points", points), levels).get()
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    assert_matches("encoded", found, expected, tolerances)


@pytest.mark.parametrize("rectify", [False, True])
@pytest.mark.parametrize("rows", [12, 4], ids=["each", "shared"])
def test_joining_matches_twin(any_device, rectify, rows):
    rng = np.random.default_rng(1)
    features, encoded, v = exact(rng.normal(size=(12, 32)), rng.normal(size=(rows, 16)), rng.normal(size=(12, 48)))
    expected = reference.encode_join(features, encoded, rectify)
    np.testing.assert_array_equal(expected[3, 32:], encoded[3 if rows == 12 else 1])
    on_device = [any_device.upload("array", a) for a in (features, encoded, v)]
    np.testing.assert_array_equal(ops.encode_join(any_device, *on_device[:2], rectify).get(), expected)
    found = ops.encode_join_bwd(any_device, on_device[2], on_device[0], rectify).get()
    np.testing.assert_array_equal(found, reference.encode_join_bwd(v, features, rectify))


@pytest.mark.parametrize("rectify", [False, True])
def test_gradients_by_central_differences(device64, rectify):
    rng = np.random.default_rng(2)
    features, v = rng.normal(size=(5, 16)), rng.normal(size=(5, 32))
    assert np.abs(features).min() > 1e-4  # no step of the differences, 1e-6, changes a sign
    rows = device64.upload("rows", rng.normal(size=(5, 16)))

    def total(features):
        return float((ops.encode_join(device64, device64.upload("x", features), rows, rectify).get() * v).sum())

    arrays = device64.upload("v", v), device64.upload("x", features)
    v_features = ops.encode_join_bwd(device64, *arrays, rectify).get()
    gradcheck(total, {"features": features}, {"features": v_features})
