"""The log of a run: JSON lines, and the same for TensorBoard."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from clsplat.atomic import replacing
from clsplat.errors import InputError
from clsplat.event_log import event_log

LOG = "log.jsonl"
"""File name of the log in the folder of a run."""

EVENTS = "tensorboard"
"""Name of the folder, in that of a run, of the log for TensorBoard."""

LOG_EVERY = 10
"""Iterations per line of the log; the loss of a line is their mean, since losses of single photos differ much."""

Append = Callable[[dict[str, Any]], None]


def log_file(path: Path, iteration: int) -> Append:
    """Begin a log of JSON lines after an iteration; return the function that appends a record.

    Lines of later iterations, written after the last checkpoint of an interrupted run, are dropped: the resumed run
    writes them again.

    Raises
    ------
    InputError
        If the file, or the log for TensorBoard beside it, cannot be written; the function raises it too.
    """
    kept = []
    if iteration and path.exists():
        for line in path.read_text(encoding="utf-8", errors="replace").split("\n"):
            try:
                if json.loads(line)["iteration"] <= iteration:
                    kept.append(line)
            # A line cut off when the run was killed, or whose blocks the disk lost.
            except (ValueError, KeyError, TypeError, RecursionError):
                continue
    with replacing(path) as file:
        file.writelines(f"{line}\n".encode() for line in kept)
    with _written(path.parent / EVENTS):
        append_event = event_log(path.parent / EVENTS, iteration)

    def append(record: dict[str, Any]) -> None:
        # Opened for each line: a file that stays open would write what failed again when it is closed.
        with _written(path), path.open("a") as log:
            log.write(json.dumps(record) + "\n")
        if append_event:
            with _written(path.parent / EVENTS):
                append_event(record)

    return append


@contextmanager
def _written(path: Path) -> Iterator[None]:
    """Raise the system's errors in the block as an InputError that names the path."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
