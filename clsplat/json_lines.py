"""Files of JSON lines: one object per line, as the log of a training and the results of a bench are."""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from types import NoneType
from typing import Any

from clsplat.errors import InputError

NUMBER = (float, int)
"""Types of a number that was measured; not finite is possible, such as the PSNR of equal images."""

KNOWN = (*NUMBER, NoneType)
"""The same for one that may be unknown."""

INTEGER_MAX = 2**64 - 1
"""Magnitude of integers in these files: that of seeds. Larger ones come from damage, and overflow as floats."""


def read_json_lines(
    path: Path, what: str, kinds: Mapping[str, tuple[type, ...]], needed: Collection[str]
) -> list[dict[str, Any]]:
    """Read the records of a file.

    A last line without a line end is ignored: it is still being written, or its process was interrupted.

    Parameters
    ----------
    path : Path
    what : str
        What a line holds, for errors.
    kinds : mapping of str to types
        Types of the entries that are used; others may be anything.
    needed : collection of str
        Entries of every record.

    Raises
    ------
    InputError
        If the file cannot be read, or a line is not such a record; the message names file and line.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error
    records = []
    for number, line in enumerate(lines, start=1):
        where = f"{path}, line {number}"
        try:
            record = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{where}: expected {what}, found {line[:60]!r}") from error
        if not isinstance(record, dict) or not record.keys() >= set(needed):
            raise InputError(f"{where}: expected {what} with {', '.join(needed)}, found {line[:60]!r}")
        for name in kinds.keys() & record.keys():
            value = record[name]
            if type(value) not in kinds[name] or (type(value) is int and abs(value) > INTEGER_MAX):
                expected = " or ".join("null" if kind is NoneType else kind.__name__ for kind in kinds[name])
                raise InputError(f"{where}: expected {name} as {expected}, found {str(value)[:60]}")
        records.append(record)
    return records
