"""Twin of the stage take."""

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]


def take_rows(array: Array, rows: Array) -> Array:
    """Take rows of an array, in any order. Arguments and result as for `clsplat.ops.take_rows`."""
    result = array[rows]
    result[rows < 0] = 0
    return result
