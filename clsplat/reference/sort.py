"""Twin of the stage sort."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def argsort(
    keys: NDArray[Any], bits: int, method: str = "auto", *, values: NDArray[np.uint32] | None = None
) -> tuple[NDArray[Any], NDArray[np.uint32]]:
    """Stable argsort of unsigned keys. Arguments and result as for `clsplat.ops.argsort`."""
    order = np.argsort(keys, kind="stable").astype(np.uint32)
    return keys[order], order if values is None else values[order]


def argsort_segments(
    keys: NDArray[Any], bits: int, ranges: NDArray[np.uint32], values: NDArray[np.uint32] | None = None
) -> NDArray[np.uint32]:
    """Stable argsort within segments. Arguments and result as for `clsplat.ops.argsort_segments`."""
    order = np.arange(len(keys), dtype=np.uint32)
    for begin, end in ranges:
        order[begin:end] = begin + np.argsort(keys[begin:end], kind="stable")
    return order if values is None else values[order]
