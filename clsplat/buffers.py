"""Device memory: blocks of a pool within a limit, and arrays of them."""

from functools import lru_cache
from math import prod
from typing import Any, cast

import numpy as np
import pyopencl as cl
import pyopencl.array
import pyopencl.tools

from clsplat.errors import DeviceError

SAME_ORDER = 4
"""Largest ratio of the sizes of two buffers of one name that are allocated with the same size."""

BLANKS = 256
"""Number of shapes whose arrays are made by copying one. A training step has some forty."""


class Reading:
    """The last value of an array, copied to the host while the host queues more work.

    It waits for the value when it is converted to a number, not before.
    """

    def __init__(self, array: cl.array.Array):
        self._value = np.empty(1, array.dtype)
        last = array.nbytes - array.dtype.itemsize
        queue, memory = cast(cl.CommandQueue, array.queue), cast(cl.Buffer, array.base_data)
        self._event = cl.enqueue_copy(queue, self._value, memory, src_offset=last, is_blocking=False)

    def __int__(self) -> int:
        self._event.wait()
        return int(self._value[0])

    def __float__(self) -> float:
        self._event.wait()
        return float(self._value[0])


class DeviceArray(cl.array.Array):
    """An array that keeps none of the host's arrays that were copied to it or from it.

    pyopencl keeps the events of up to 12 copies with an array, and each of them the host's array. Nothing waits for
    these events: all work is in one queue, which runs in order.
    """

    def add_event(self, evt: cl.Event) -> None:
        pass


class Buffers:
    """Memory of a device.

    Parameters
    ----------
    queue : pyopencl.CommandQueue
    label : str
        Name of the device in errors.
    limit : int
        Largest total size of all buffers, those kept for reuse included, bytes.

    Attributes
    ----------
    peak : int
        Largest total size of all buffers so far, bytes.
    pool : pyopencl.tools.MemoryPool
    """

    def __init__(self, queue: cl.CommandQueue, label: str, limit: int):
        self.peak = 0
        self._queue, self._label, self._limit = queue, label, limit
        self._most = int(queue.device.max_mem_alloc_size)
        self.pool = cl.tools.MemoryPool(cl.tools.ImmediateAllocator(queue))
        self._largest: dict[str, int] = {}
        self._blank = lru_cache(BLANKS)(self._new_blank)
        self._block = lru_cache(BLANKS)(self._size_class)

    @property
    def memory(self) -> int:
        """Current total size of all buffers, bytes, including those kept for reuse."""
        return int(self.pool.managed_bytes)

    def empty(self, what: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> cl.array.Array:
        """Uninitialised array. `what` names it in errors.

        Raises
        ------
        DeviceError
            If the array exceeds the device's largest buffer, its memory, or the limit.
        """
        nbytes = prod(shape) * dtype.itemsize
        # Of what is far too large, the pool knows no size class.
        block = self._block(nbytes) if 0 < nbytes <= self._most else nbytes
        if block > self._most:
            raise DeviceError(
                f"{what}: needs a buffer of {block / 2**20:.0f} MiB, but {self._label} allows at most "
                f"{self._most / 2**20:.0f} MiB per buffer; use fewer Gaussians or a smaller image (--downscale)"
            )
        return self._array(shape, dtype, self.allocate(what, nbytes) if nbytes else None)

    def first(self, array: cl.array.Array, count: int) -> cl.array.Array:
        """The first `count` values of a flat array, in the same memory."""
        return array if array.shape == (count,) else self._array((count,), array.dtype, array.base_data)

    def _array(self, shape: tuple[int, ...], dtype: np.dtype[Any], memory: Any) -> cl.array.Array:
        result = DeviceArray.__new__(DeviceArray)
        fields = self._blank(shape, dtype).copy()
        fields["events"], fields["base_data"] = [], memory
        result.__dict__ = fields
        return result

    def _new_blank(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> dict[str, Any]:
        """Attributes of an array without memory. To make one takes as long as several launches; to copy it does
        not."""
        nothing: Any = lambda nbytes: None  # noqa: E731
        result = cl.array.Array(self._queue, shape, dtype, allocator=nothing)
        result.allocator = None
        return vars(result)

    def _size_class(self, nbytes: int) -> int:
        """Bytes that the pool allocates for a buffer of `nbytes`: it rounds up to a size class."""
        return int(self.pool.alloc_size(self.pool.bin_number(nbytes)))

    def capacity(self, what: str, nbytes: int) -> int:
        """Bytes to allocate for `nbytes`: the largest size of this name so far, if within `SAME_ORDER`.

        Lists of intersections differ in length from image to image. Blocks of one size can be reused.
        """
        largest = self._largest.get(what, 0)
        if largest / SAME_ORDER <= nbytes <= largest:
            return largest
        if nbytes > largest:
            self._largest[what] = nbytes
            if largest and self._block(nbytes) > self._block(largest):
                self.pool.free_held()  # the smaller blocks
        return nbytes

    def forget(self) -> None:
        """Free the blocks that are kept for reuse, and forget sizes: other Gaussians need others."""
        self._largest.clear()
        self.pool.free_held()

    def allocate(self, what: str, nbytes: int) -> cl.MemoryObjectHolder:
        """A block of at least `nbytes`. Errors as for `empty`."""
        capacity, pool = self.capacity(what, nbytes), self.pool
        if pool.managed_bytes + self._block(capacity) > self._limit:
            pool.free_held()
            capacity = nbytes
            if pool.managed_bytes + self._block(capacity) > self._limit:
                raise DeviceError(
                    f"{what}: needs {nbytes / 2**20:.0f} MiB in addition to {self.memory / 2**20:.0f} MiB in use, "
                    f"but the limit is {self._limit / 2**20:.0f} MiB (--memory-limit); use fewer Gaussians or a "
                    "smaller image (--downscale)"
                )
        try:
            block = pool.allocate(capacity)
        except cl.MemoryError as error:
            raise DeviceError(
                f"{what}: {self._label} has no memory left for {nbytes / 2**20:.0f} MiB; use fewer Gaussians or a "
                "smaller image (--downscale)"
            ) from error
        self.peak = max(self.peak, pool.managed_bytes)
        return block
