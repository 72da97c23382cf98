"""Twin of the stage scan."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def exclusive_scan(values: NDArray[np.uint32], what: str = "scan") -> tuple[NDArray[Any], int]:
    """Exclusive prefix sum. Arguments and result as for `clsplat.ops.exclusive_scan`."""
    sums = np.concatenate([[0], np.cumsum(values, dtype=np.uint64)])
    if sums[-1] >= 2**32:
        raise OverflowError(f"{what}: expected a total below 2^32, found {sums[-1]}")
    return sums.astype(np.uint32), int(sums[-1])
