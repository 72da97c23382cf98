"""Twin of the stage observe."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def observe(extents: Array, v_means2d: Array, width: int, height: int, grad_sum: Array, seen: Array) -> None:
    """Add an iteration to the statistics, in place. Arguments as for `clsplat.ops.observe`."""
    visible = extents[:, 0] > 0
    grad_sum[visible] += np.hypot(v_means2d[visible, 0] * (width / 2), v_means2d[visible, 1] * (height / 2))
    seen[visible] += 1


def add_column(values: Array, column: int, sums: Array, factor: float = 1.0) -> None:
    """Add a column, times a factor, to sums, in place. Arguments as for `clsplat.ops.add_column`."""
    sums[:, 0] += factor * values[: len(sums), column]
