"""Twin of the stage sort."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def argsort(keys: NDArray[Any], bits: int, method: str = "auto") -> tuple[NDArray[Any], NDArray[np.uint32]]:
    """Stable argsort of unsigned keys; arguments and result as `clsplat.ops.argsort`."""
    order = np.argsort(keys, kind="stable").astype(np.uint32)
    return keys[order], order
