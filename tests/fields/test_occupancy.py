"""Occupancy grids of fields: which cells hold something."""

import numpy as np

from clsplat.fields.occupancy import FULL_UPDATES, SHARE, THRESHOLD, Occupancy


def test_occupancy_forgets_and_finds():
    """A cell that is empty when it is visited fades; one that is not is occupied at once."""
    grid = Occupancy(np.full((8, 8, 8), THRESHOLD, np.float32))
    assert grid.occupied.all()
    rng = np.random.default_rng(0)
    inside = lambda p: np.where(np.abs(p - 0.5).max(axis=1) < 0.25, 1.0, 0.0)  # noqa: E731
    for number in range(FULL_UPDATES):
        grid.update(number, rng, inside)
    expected = np.zeros((8, 8, 8))
    expected[2:6, 2:6, 2:6] = 1
    np.testing.assert_array_equal(grid.occupied, expected)
    for number in range(FULL_UPDATES, FULL_UPDATES + 20 * SHARE):
        grid.update(number, rng, lambda p: np.where(p[:, 0] < 0.125, 1.0, 0.0))
    assert grid.occupied[:, :, 0].all() and not grid.occupied[:, :, 1:].any()
