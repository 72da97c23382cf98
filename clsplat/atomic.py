"""Files that are either written as a whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from clsplat.errors import InputError


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file for writing that takes the place of `path` when the block ends without an exception.

    Until then the bytes go to a hidden file beside `path`; an exception removes it and leaves `path` as it was.

    Raises
    ------
    InputError
        If the file cannot be written: no such folder, no permission, disk full.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            yield file
        os.replace(part, path)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: expected a place that can be written to, found: {reason}") from error
    finally:
        with suppress(OSError):
            part.unlink()
