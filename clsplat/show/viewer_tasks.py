"""Work that browsers ask for and that the thread that owns the device does between frames."""

from collections import deque
from collections.abc import Callable, Iterator

from clsplat.gaussians import Gaussians

Task = Callable[[Gaussians], Iterator[None] | None]
"""A function of the scene. If it returns an iterator, the iterator's steps run one by one between frames."""

TASKS_MAX = 100
"""Largest number of waiting tasks; further ones are dropped. A page can send them faster than they are done."""


class Tasks:
    """A queue of tasks. `add` may be called by any thread, `run` only by the one that owns the device."""

    def __init__(self) -> None:
        self._waiting: deque[Task] = deque()
        self._steps: Iterator[None] | None = None

    @property
    def busy(self) -> bool:
        """Whether a task waits or has begun."""
        return bool(self._waiting or self._steps)

    def add(self, task: Task) -> None:
        """Let a task wait for its turn."""
        if len(self._waiting) < TASKS_MAX:
            self._waiting.append(task)

    def run(self, gaussians: Gaussians) -> None:
        """Run the next task, or its next step. After an error, its task is over.

        Only one, because the task after an edit needs the scene that the edit has changed.
        """
        try:
            if self._waiting and self._steps is None:
                self._steps = self._waiting.popleft()(gaussians)
            if self._steps is not None and next(self._steps, self) is self:
                self._steps = None
        except Exception:
            self._steps = None
            raise
