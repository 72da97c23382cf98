"""Atomic writing of files: a file is either complete or unchanged, also after a power cut."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import BinaryIO

from clsplat.errors import InputError

NAME_MAX = 200
"""Most bytes of a name to which something is added. File systems allow 255 in all."""

PART = re.compile(r"\..*\.[0-9a-f]{16}\.part", re.DOTALL)
"""Name of a hidden file that `replacing` writes: that of the file, `shortened`, and a random number. It differs from
those of all other processes, also on machines that share the folder."""


def shortened(name: str) -> str:
    """Cut a file's name to `NAME_MAX` bytes, between two characters."""
    while len(os.fsencode(name)) > NAME_MAX:
        name = name[:-1]
    return name


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file for writing that replaces `path` when the block ends without an exception.

    Until then the bytes are written to a hidden file next to `path`. An exception removes the hidden file and leaves
    `path` unchanged. The bytes reach the disk before the name does, and both before the block is left: a power cut
    leaves the old file or the new one.

    Raises
    ------
    InputError
        If the file cannot be written, for example because the folder does not exist or the disk is full.
    """
    path = Path(path)
    part = path.with_name(f".{shortened(path.name)}.{token_hex(8)}.part")
    try:
        with part.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            part.unlink()


def remove(path: Path) -> None:
    """Remove a file, if it exists.

    Raises
    ------
    InputError
        If this fails.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot remove {path}: {error.strerror or error}") from error


def _sync_folder(folder: Path) -> None:
    """Sync a folder's names where the system can. Windows opens no folders, and some file systems refuse."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def remove_parts(folder: Path) -> None:
    """Remove the hidden files directly in a folder that processes left which died while they wrote.

    The caller must know that no living process writes there.
    """
    for path in folder.iterdir():
        if PART.fullmatch(path.name):
            with suppress(OSError):
                path.unlink()
