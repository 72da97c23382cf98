"""Stage hashgrid: its hash in numbers, interpolation, against the twin and central differences, and the same bits."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.field_stages import HashLevels
from clsplat.reference.hashgrid import corners
from clsplat.testing import assert_matches, gradcheck

# Levels with an entry per corner, and levels with collisions.
LEVELS = HashLevels.geometric(5, 4, 40, 512)


ONE_LEVEL = HashLevels.geometric(1, 6, 6, 512)


def inputs(points=777, seed=0, levels=LEVELS):
    rng = np.random.default_rng(seed)
    positions = rng.uniform(size=(points, 3))
    positions[:4] = [[0, 0, 0], [1, 1, 1], [0.5, 1, 0], [-0.1, 0.3, 1.2]]
    table, v_features = (levels.offsets[-1], 2), (points, 2 * len(levels.resolutions))
    arrays = positions, rng.normal(size=table), rng.normal(size=v_features)
    return [a.astype(np.float32).astype(np.float64) for a in arrays]


def by_kernel(device, positions, table, v_features, levels=LEVELS):
    x = device.upload("positions", positions)
    features = ops.hashgrid_fwd(device, x, device.upload("table", table), levels)
    return features.get(), ops.hashgrid_bwd(device, x, device.upload("v", v_features), levels).get()


def test_levels_follow_the_paper():
    """Base for synthetic scenes: 16 levels from 16 to 2048 cells, of at most 2^19 entries (table 1)."""
    levels = HashLevels.geometric(16, 16, 2048, 2**19)
    assert levels.resolutions[0] == 16 and levels.resolutions[-1] == 2048
    ratios = np.array(levels.resolutions[1:]) / levels.resolutions[:-1]
    assert (np.abs(ratios - 128 ** (1 / 15)) < 0.07).all()  # rounded to whole cells
    sizes = np.diff(levels.offsets)
    assert sizes[0] == 17**3 and (sizes[-8:] == 2**19).all()


def test_the_hash_in_numbers():
    """A corner far from the origin: the products wrap at 32 bits."""
    entries, weights = corners(np.array([[100.25, 200.5, 300.75]]) / 1000, 1000, 2**19)
    expected = 100 ^ (200 * 2654435761 & 0xFFFFFFFF) ^ (300 * 805459861 & 0xFFFFFFFF)
    assert entries[0, 0] == expected % 2**19
    np.testing.assert_allclose(weights[0, [0, 7]], [0.75 * 0.5 * 0.25, 0.25 * 0.5 * 0.75], rtol=1e-9)


def test_a_linear_field_is_interpolated_exactly(device64):
    """On a level with an entry per corner, a table that is linear in the corner's place gives a linear function."""
    z, y, x = np.mgrid[:7, :7, :7] / 6
    table = np.stack([1 + 2 * x - y, 3 * z], axis=-1).reshape(-1, 2)
    p = np.random.default_rng(0).uniform(size=(50, 3))
    found = ops.hashgrid_fwd(device64, device64.upload("p", p), device64.upload("t", table), ONE_LEVEL).get()
    np.testing.assert_allclose(found, np.stack([1 + 2 * p[:, 0] - p[:, 1], 3 * p[:, 2]], axis=1), atol=1e-13)


@pytest.mark.parametrize("points", [1, 777])
def test_matches_twin(any_device, points):
    check(any_device, points)


@pytest.mark.parametrize("points", [1, 777])
def test_matches_twin_as_cpu_and_gpu(configured_device, points):
    check(configured_device, points)


def test_several_units_share_a_level(device):
    """There are fewer levels than compute units, on a machine of two or more."""
    check(device, 777, ONE_LEVEL)


def test_a_hash_of_a_number_of_entries_that_is_no_power_of_two(configured_device):
    check(configured_device, 777, HashLevels.geometric(2, 16, 40, 500))


def check(device, points, levels=LEVELS):
    positions, table, v_features = inputs(max(points, 4), levels=levels)
    positions, v_features = positions[-points:], v_features[-points:]
    tolerances = DOUBLE if device.real == np.float64 else FLOAT
    features, v_table = by_kernel(device, positions, table, v_features, levels)
    assert_matches("features", features, reference.hashgrid_fwd(positions, table, levels), tolerances)
    assert_matches("v_table", v_table, reference.hashgrid_bwd(positions, v_features, levels), tolerances)


def test_gradients_by_central_differences(device64):
    positions, table, v = inputs(40)
    gradcheck(
        lambda table: float((by_kernel(device64, positions, table, v)[0] * v).sum()),
        {"table": table},
        {"table": by_kernel(device64, positions, table, v)[1]},
    )


def test_gradients_repeat_to_the_bit(configured_device):
    positions, table, v = inputs(3000)
    first = by_kernel(configured_device, positions, table, v)[1]
    for _ in range(3):
        np.testing.assert_array_equal(by_kernel(configured_device, positions, table, v)[1], first)
