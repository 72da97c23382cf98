"""A scene in parts on the disk: an index of the rows of one or several PLYs, with bounds and a digest of each part.

The index is named by a digest of all that it says but the files' names, and holds the digests of its parts: a part is
checked when it is read, and the others need not be read. The rows stay in the files that they were written to.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from clsplat.atomic import replacing
from clsplat.blocks.jobs import digest_of
from clsplat.blocks.sight import Bounds
from clsplat.errors import InputError
from clsplat.formats.ply import REQUIRED, names_of, to_gaussians, with_coefficients
from clsplat.formats.ply_parts import PlyParts
from clsplat.formats.validity import reading
from clsplat.gaussians import Gaussians

INDEX = ".parts"
"""Suffix of an index."""

ROWS = ".rows"
"""Suffix of a file that holds the rows of a part alone and is named by their digest: what a worker without a shared
folder has of a scene."""


PART = 1 << 13
"""Most rows of a part, 2 MB of degree 3. In smaller parts fewer rows are read that no photo shows; in larger ones the
index is shorter, and a disk reads faster (effect: docs/experiments/blocks.md)."""


class Part(NamedTuple):
    """Consecutive rows of a PLY as `clsplat.formats.ply.save_ply` writes it.

    file: its name, in the folder of the index; begin, size: bytes; rows: their number; digest: of the bytes; low,
    high, radius: `clsplat.blocks.sight.Bounds` of all rows, as float32.
    """

    file: str
    begin: int
    size: int
    rows: int
    digest: str
    low: list[float]
    high: list[float]
    radius: float

    @property
    def coefficients(self) -> int:
        """Number K of the spherical harmonics' coefficients of a Gaussian."""
        return (self.size // (4 * self.rows) - len(names_of(1))) // 3 + 1


def write_index(files: list[Path]) -> Path:
    """Write the index of a scene that consists of PLYs in one folder, in their order; return its path.

    Raises
    ------
    InputError
        If a file cannot be read, or the index cannot be written.
    """
    parts = [part for file in files for part in parts_of(file)]
    path = files[0].with_name(_name(parts) + INDEX)
    content = json.dumps(parts).encode()
    if not path.exists() or path.read_bytes() != content:
        with replacing(path) as out:
            out.write(content)
    return path


def _name(parts: list[Part]) -> str:
    return digest_of(json.dumps([part[1:] for part in parts]).encode())


def parts_of(file: Path) -> Iterator[Part]:
    """Read a PLY and yield its parts, with their bounds and digests.

    Raises
    ------
    InputError
        If the file cannot be read, or a value is not finite.
    """
    rows = PlyParts(file)
    begin = rows.begin
    for stored, gaussians in rows.chunks(PART):
        each = Bounds.of(gaussians)
        low, high = np.nextafter(
            [each.low.min(axis=0), each.high.max(axis=0)], [[-np.inf], [np.inf]], dtype=np.float32
        ).tolist()
        radius = float(np.nextafter(each.radius.max(), np.inf, dtype=np.float32))
        yield Part(file.name, begin, stored.nbytes, len(stored), digest_of(stored.tobytes()), low, high, radius)
        begin += stored.nbytes


def read_index(path: Path) -> list[Part]:
    """Read the parts of a scene.

    Raises
    ------
    InputError
        If the index cannot be read or has been changed.
    """
    with reading(path):
        content = path.read_bytes()
    try:
        parts = [Part(*part) for part in json.loads(content)]
    except (TypeError, ValueError) as error:
        raise _changed(path) from error
    if _name(parts) != path.stem:
        raise _changed(path)
    return parts


def bounds_of(parts: list[Part]) -> Bounds:
    """Bounds of parts."""
    return Bounds(*(np.array([part[k] for part in parts], np.float64) for k in (-3, -2, -1)))


def read_part(folder: Path, part: Part) -> Gaussians:
    """Read a part of a scene whose index is in a folder.

    Raises
    ------
    InputError
        If it cannot be read or has been changed.
    """
    path, begin = folder / f"{part.digest}{ROWS}", 0
    if not path.exists():
        path, begin = folder / part.file, part.begin
    with reading(path), open(path, "rb") as file:
        file.seek(begin)
        data = file.read(part.size)
    if digest_of(data) != part.digest:
        raise _changed(path)
    names = names_of(part.coefficients)
    rest = [name for name in names if name.startswith("f_rest_")]
    return to_gaussians(path, np.frombuffer(data, [(name, "<f4") for name in names]), [*REQUIRED, *rest])


def read_scene(index: Path, coefficients: int) -> Gaussians:
    """Read all of a scene, with at least `coefficients` of the spherical harmonics.

    Raises
    ------
    InputError
        If a file cannot be read or has been changed.
    """
    parts = (read_part(index.parent, part) for part in read_index(index))
    return Gaussians.concatenate([with_coefficients(part, coefficients) for part in parts])


def _changed(path: Path) -> InputError:
    return InputError(f"{path}: expected a scene as it was written, found a changed file; plan the run again")
