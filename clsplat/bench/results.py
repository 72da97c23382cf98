"""The file of results of `clsplat bench quality`: one JSON object per line."""

import json
from pathlib import Path
from typing import Any

from clsplat.atomic import replacing
from clsplat.errors import InputError

Record = dict[str, Any]

FILE = "results.jsonl"
"""Name of the file."""

KEYS = ("scene", "method", "max_gaussians", "iterations", "seed", "device")
"""Entries of every record. Records that agree in all of them belong to one training."""


def read_records(path: Path) -> list[Record]:
    """Read the records of a file; an empty list if the file does not exist.

    A last line without a line end is ignored: the bench was interrupted while it wrote the line.

    Raises
    ------
    InputError
        If the file cannot be read, or a line is not a record.
    """
    if not path.exists():
        return []
    try:
        lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error
    records = []
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            if not set(KEYS) <= record.keys():
                raise ValueError(f"expected {', '.join(KEYS)}")
        except (ValueError, AttributeError) as error:
            raise InputError(f"{path}, line {number}: expected a record of a bench, found {line[:60]!r}") from error
        records.append(record)
    return records


def append_record(path: Path, record: Record) -> None:
    """Append a record to the file immediately, so that it is not lost if the bench is killed."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record, allow_nan=False) + "\n")


def write_records(path: Path, records: list[Record]) -> None:
    """Replace the records of a file."""
    with replacing(path) as file:
        file.writelines((json.dumps(record, allow_nan=False) + "\n").encode() for record in records)
