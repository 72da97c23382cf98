"""Twin of the stage finite."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def count_not_finite(values: NDArray[Any]) -> int:
    """Count the values that are not finite. Argument and result as for `clsplat.ops.count_not_finite`."""
    return int(np.count_nonzero(~np.isfinite(values)))
