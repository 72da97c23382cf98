"""The folder of a run: one process at a time writes to it."""

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from clsplat.atomic import remove_parts, replacing
from clsplat.errors import InputError

LOCK = ".lock"
"""Name of the file in the folder of a run that the system locks while a process holds the folder."""

HOLDER = ".lock.json"
"""Name of the file that says who holds the folder. Some systems let nobody else read a locked file."""


@contextmanager
def held(out: Path) -> Iterator[None]:
    """Hold the folder of a run while the block runs, against other processes and threads.

    The system ends the lock when the process ends, even if it is killed. A thread may hold a folder more than once.
    The folder is created if it is missing, and removed again if the block leaves nothing in it. Files that killed
    processes left half written are removed.

    Raises
    ------
    InputError
        If the folder is held already, with the process, its host and the time since when; or if it cannot be created
        or locked.
    """
    out = out.resolve()
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create {out}: {error.strerror or error}") from error
    lock = FileLock(out / LOCK, blocking=False, is_singleton=True)
    again = lock.is_locked
    try:
        lock.acquire()
    except Timeout:
        raise InputError(
            f"{out}: expected a folder that no other run writes to, found one that {_holder(out)} holds; wait until "
            "it ends, or choose another folder with -o"
        ) from None
    except OSError as error:
        raise InputError(f"cannot lock {out}: {error.strerror or error}") from error
    try:
        if not again:
            remove_parts(out)
            _sign(out)
        yield
    finally:
        if not again:  # the lock's file goes while it is locked: a process that opened it before notices
            for name in (HOLDER, LOCK):
                with suppress(OSError):
                    (out / name).unlink()
        lock.release()
        for folder in missing:
            with suppress(OSError):  # it holds a run
                folder.rmdir()


def _sign(out: Path) -> None:
    """Write the process that holds the folder, its host and the time to the folder."""
    since = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    with replacing(out / HOLDER) as file:
        file.write(json.dumps({"process": os.getpid(), "host": socket.gethostname(), "since": since}).encode())


def _holder(out: Path) -> str:
    """Process that holds the folder, if it is known: a process signs after it has locked."""
    try:
        signed = json.loads((out / HOLDER).read_text())
        return f"process {signed['process']} on {signed['host']} (since {signed['since']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
