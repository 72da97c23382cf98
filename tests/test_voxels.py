"""Stage voxels: interpolation of a sparse grid, total variation, against the twin and central differences."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.field_stages import NO_ROW, TV_EPS
from clsplat.testing import assert_matches, gradcheck

CORNERS, FEATURES = (4, 7, 6), 3  # along z, y, x


def inputs(points=500, share=0.7, seed=0, closed=False):
    """A grid of which a share of the corners have rows, in a random order; exact in single precision."""
    rng = np.random.default_rng(seed)
    given = rng.uniform(size=CORNERS) < share
    given[..., -1] &= not closed
    corners = np.flatnonzero(given).astype(np.uint32)
    rng.shuffle(corners)
    index = np.full(np.prod(CORNERS), NO_ROW, np.uint32)
    index[corners] = np.arange(len(corners))
    index = index.reshape(CORNERS)
    if closed:
        index[..., -1] = index[..., 0]
    positions = rng.uniform(size=(points, 3))
    positions[:2] = [[0, 0, 0], [1, 1, 1]]
    arrays = positions, rng.normal(size=(len(corners), FEATURES)), rng.normal(size=(points, FEATURES))
    exact = [a.astype(np.float32).astype(np.float64) for a in arrays]
    return *exact, index, corners


def by_kernel(device, positions, table, v_features, index, corners, first=0, count=None):
    x, i = device.upload("x", positions), device.upload("index", index, np.uint32)
    t, rows = device.upload("table", table), len(table)
    features = ops.voxels_fwd(device, x, i, t)
    v_table = ops.voxels_bwd(device, x, i, rows, device.upload("v", v_features))
    variation = device.upload("v_table", np.zeros(table.shape))
    places = device.upload("corners", corners, np.uint32)
    ops.voxels_tv(device, i, places, t, variation, (2.0, 0.5), first, rows if count is None else count)
    return features.get(), v_table.get(), variation.get()


def by_twin(positions, table, v_features, index, corners, first=0, count=None):
    variation, rows = np.zeros(table.shape), len(table)
    reference.voxels_tv(index, corners, table, variation, (2.0, 0.5), first, rows if count is None else count)
    features = reference.voxels_fwd(positions, index, table)
    return features, reference.voxels_bwd(positions, index, rows, v_features), variation


CLOSED = pytest.mark.parametrize("closed", [False, True], ids=["open", "closed"])


@CLOSED
@pytest.mark.parametrize("share", [0.02, 0.7, 1.0])
def test_matches_twin(any_device, share, closed):
    check(any_device, inputs(share=share, closed=closed))


@CLOSED
def test_matches_twin_as_cpu_and_gpu(configured_device, closed):
    check(configured_device, inputs(closed=closed))


def test_a_closed_grid_goes_on_behind_its_end(device64):
    """Rotated by two cells, the features and all gradients are the same."""
    positions, table, v, index, corners = given = inputs(closed=True)
    turned = np.roll(index[..., :-1], 2, axis=2)
    turned = np.concatenate([turned, turned[..., :1]], axis=2)
    places = {row: place for place, row in reversed(list(enumerate(turned.ravel())))}
    moved = positions.copy()
    moved[2:, 0] = (positions[2:, 0] + 2 / (CORNERS[2] - 1)) % 1
    moved[:2, 0] = 2 / (CORNERS[2] - 1)  # where the grid is closed
    found = by_kernel(device64, moved, table, v, turned, np.array([places[row] for row in range(len(corners))]))
    for array, expected in zip(found, by_kernel(device64, *given), strict=True):
        np.testing.assert_allclose(array, expected, rtol=1e-9, atol=1e-12)


def test_a_part_of_the_rows_beyond_the_last_one(device64):
    given = inputs()
    rows = len(given[1])
    check(device64, given, rows - 3, 10)
    moved = by_kernel(device64, *given, rows - 3, 10)[2].any(axis=1)
    assert set(np.flatnonzero(moved)) <= {*range(rows - 3, rows), *range(7)}


def check(device, given, *part):
    tolerances = DOUBLE if device.real == np.float64 else FLOAT
    for name, found, expected in zip(
        ("features", "v_table", "variation"), by_kernel(device, *given, *part), by_twin(*given, *part), strict=True
    ):
        assert_matches(name, found, expected, tolerances)


@CLOSED
def test_gradients_by_central_differences(device64, closed):
    """Of the interpolation, and of the sum over corners of the length of the differences."""
    given = positions, table, v, index, corners = inputs(closed=closed)
    _, v_table, variation = by_kernel(device64, *given)

    def interpolated(table):
        return float((by_kernel(device64, positions, table, v, index, corners)[0] * v).sum())

    def total_variation(table):
        total = 0.0
        for z, y, x in np.argwhere(index != NO_ROW):
            here, d = table[index[z, y, x]], np.zeros((3, FEATURES))
            if closed and x == CORNERS[2] - 1:
                continue  # the first corner again
            for axis, after in enumerate([(z, y, x + 1), (z, y + 1, x), (z + 1, y, x)]):
                if (np.array(after) < CORNERS).all() and index[after] != NO_ROW:
                    d[axis] = table[index[after]] - here
            total += float(np.sqrt((d**2).sum(axis=0) + TV_EPS) @ [2.0, 0.5, 0.5])
        return total

    gradcheck(interpolated, {"table": table}, {"table": v_table})
    gradcheck(total_variation, {"table": table}, {"table": variation})


def test_gradients_repeat_to_the_bit(configured_device):
    given = inputs(3000)
    first = by_kernel(configured_device, *given)
    for before, again in zip(first, by_kernel(configured_device, *given), strict=True):
        np.testing.assert_array_equal(again, before)
