"""Threads that work on leaves of a scene, a few at a time."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS = 4
"""Leaves that are worked on at once. Each takes some hundred megabytes, and NumPy lets few threads run together."""


def in_threads(call: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield the results of a function for items, in their order.

    An item is drawn when there is a thread for it, so that no more than `THREADS` are in memory.
    """
    running: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(THREADS) as pool:
        for item in items:
            running.append(pool.submit(call, item))
            del item
            if len(running) == THREADS:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()
