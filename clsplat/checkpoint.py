"""What a run leaves in its folder so that it can go on: the checkpoint and the log."""

import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.io.atomic import replacing


def save_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Write named arrays to an uncompressed .npz file, whole or not at all."""
    with replacing(path) as file:
        np.savez(file, **arrays)


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Read what `save_arrays` wrote.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            return dict(file)
    except FileNotFoundError as error:
        raise InputError(
            f"{path}: expected a checkpoint to resume from, found none; start without --resume"
        ) from error
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: expected a checkpoint of clsplat, found a damaged file: {error}") from error


@contextmanager
def log_file(path: Path, iteration: int) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Open a log of JSON lines after `iteration`; yields the function that appends a record.

    Lines of later iterations, which a run wrote between its last checkpoint and its end, are dropped: the resumed run
    writes them again.
    """
    kept = []
    if iteration and path.exists():
        for line in path.read_text().splitlines():
            try:
                if json.loads(line)["iteration"] <= iteration:
                    kept.append(line)
            except (json.JSONDecodeError, KeyError):  # the line that was being written when the run was killed
                continue
    with replacing(path) as file:
        file.writelines(f"{line}\n".encode() for line in kept)
    with path.open("a") as log:

        def append(record: dict[str, Any]) -> None:
            log.write(json.dumps(record) + "\n")
            log.flush()

        yield append
