"""The file of results that `clsplat bench quality` grows: a JSON object per line."""

import json
from pathlib import Path
from typing import Any

from clsplat.atomic import replacing
from clsplat.errors import InputError

Record = dict[str, Any]

FILE = "results.jsonl"
"""Its name in the folder of a bench."""

KEYS = ("scene", "method", "max_gaussians", "iterations", "device")
"""What every record has; records that agree in all of these belong to one training."""


def read_records(path: Path) -> list[Record]:
    """The records in a file; none where there is no file.

    A last line without its end is left out: a bench was interrupted while it wrote it.

    Raises
    ------
    InputError
        If the file cannot be read, or a line is no record.
    """
    if not path.exists():
        return []
    try:
        lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected results that can be read, found: {error}") from error
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
    """Add a line at once: what is measured is not lost when the bench is killed."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record, allow_nan=False) + "\n")


def write_records(path: Path, records: list[Record]) -> None:
    """Write all records in the place of those that are there."""
    with replacing(path) as file:
        file.writelines((json.dumps(record, allow_nan=False) + "\n").encode() for record in records)
