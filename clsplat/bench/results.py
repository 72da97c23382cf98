"""The file of results of `clsplat bench quality`: one JSON object per line."""

import json
from pathlib import Path
from types import NoneType
from typing import Any

from clsplat.atomic import replacing
from clsplat.json_lines import KNOWN, read_json_lines

Record = dict[str, Any]

FILE = "results.jsonl"
"""Name of the file."""

KEYS = ("scene", "method", "max_gaussians", "iterations", "seed", "device")
"""Entries of every record. Records that agree in all of them belong to one training."""

FIGURES = (
    *("psnr", "ssim", "flip", "worst", "rare_psnr", "best", "train_psnr", "fps", "load"),
    *("seconds", "cpu_seconds", "num_gaussians", "spz_bytes", "memory_bytes"),
)
"""Entries that are numbers, or None where they were not measured."""

TEXTS = ("scene", "method", "device", "photos", "failed", "driver", "version", "date")

KINDS: dict[str, tuple[type, ...]] = {
    **{name: KNOWN for name in FIGURES},
    **{name: (str,) for name in TEXTS},
    **{name: (int,) for name in ("iterations", "iteration", "seed", "compute_units")},
    "max_gaussians": (int, NoneType),
    "commit": (str, NoneType),
}
"""Types of the entries of a record that charts and reports use."""


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
    return read_json_lines(path, "a record of a bench", KINDS, KEYS)


def append_record(path: Path, record: Record) -> None:
    """Append a record to the file immediately, so that it is not lost if the bench is killed."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record, allow_nan=False) + "\n")


def write_records(path: Path, records: list[Record]) -> None:
    """Replace the records of a file."""
    with replacing(path) as file:
        file.writelines((json.dumps(record, allow_nan=False) + "\n").encode() for record in records)
