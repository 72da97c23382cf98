"""The grid of occupied cells: where a field's rays have samples."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

CELLS = 128
"""Cells along an edge of the grid (Müller et al. 2022, appendix E)."""

EVERY = 16
"""Iterations between two updates (Müller et al. 2022, appendix E)."""

FULL_UPDATES = 4
"""Number of updates of all cells at the start; later updates visit an eighth of them in turn. The paper's code visits
half of them, at random; that would take a third of the time of a training on a CPU."""

SHARE = 8
"""Updates in which each cell is visited once."""

DECAY = 0.6
"""Factor on a cell's value before it is compared with a new one: 0.95 of the paper per update, over `SHARE` of
them."""

THRESHOLD = 0.01
"""Optical depth of a step above which a cell is occupied, or the mean of all cells if that is less (Müller et al.
2022, appendix E)."""


class Occupancy:
    """Optical depths of a step in the cells of the unit cube, and which of them are occupied.

    Attributes
    ----------
    values : (G, G, G) float32
        [z, y, x]; `THRESHOLD` everywhere until the first update, so that all cells are occupied.
    """

    def __init__(self, values: NDArray[np.float32]):
        self.values = values

    @property
    def occupied(self) -> NDArray[np.uint8]:
        """1 in cells that may hold anything, (G, G, G)."""
        threshold = min(THRESHOLD, float(self.values.mean(dtype=np.float64)))
        return (self.values >= threshold).astype(np.uint8)

    def update(
        self, number: int, rng: np.random.Generator, depths_at: Callable[[NDArray[np.float64]], NDArray[Any]]
    ) -> None:
        """Compare cells with the field at a random point in each.

        Parameters
        ----------
        number : int
            Of the update, from 0.
        rng : Generator
            Draws the points.
        depths_at : callable
            Optical depths of a step (P,) at points (P, 3) of the unit cube.
        """
        flat, share = self.values.reshape(-1), 1 if number < FULL_UPDATES else SHARE
        cells = np.arange(number % share, flat.size, share)
        places = np.stack(np.unravel_index(cells, self.values.shape)[::-1], axis=1)
        found = depths_at((places + rng.uniform(size=places.shape)) / len(self.values))
        decay = DECAY if share == SHARE else 0.0  # at the start the field changes entirely between two updates
        flat[cells] = np.maximum(decay * flat[cells], found)
