"""A PLY of Gaussians that is read or written in parts, for scenes that do not fit the memory."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.formats.ply import comments_of, properties, read_comments, table_of, to_gaussians
from clsplat.formats.ply_container import bytes_before, check_size, read_header
from clsplat.formats.validity import reading
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

CHUNK = 1 << 16
"""Number of rows that are read at a time, 16 MB of degree 3."""


class PlyParts:
    """The rows of a PLY of Gaussians, read from the disk when they are needed.

    Attributes
    ----------
    count : int
        Number of Gaussians.
    binary : bool
        Whether rows can be read. Those of an ASCII file have no known places.
    dtype : np.dtype
        Of the rows as they are stored.
    mode, offset
        As in `clsplat.formats.load_gaussians`.

    Raises
    ------
    InputError
        As `clsplat.formats.ply.load_ply`, except for values that are not finite.
    """

    def __init__(self, path: Path):
        self._path = path
        with reading(path), open(path, "rb") as file:
            header = read_header(path, file)
        self._wanted = properties(path, header)
        check_size(path, header)
        self.count = header.rows["vertex"]
        self.binary = header.order != "="
        self.dtype = header.elements["vertex"].dtype(header.order if self.binary else "<")
        self._first = header.length + (bytes_before(header) if self.binary else 0)
        self.mode, self.offset = read_comments(header.comments)

    def chunks(self) -> Iterator[tuple[Array, Gaussians]]:
        """Yield consecutive rows as they are stored, and as Gaussians.

        Raises
        ------
        InputError
            If the file cannot be read, or a value is not finite.
        """
        for first in range(0, self.count, CHUNK):
            with reading(self._path):
                rows: Array = np.fromfile(
                    self._path,
                    self.dtype,
                    min(CHUNK, self.count - first),
                    offset=self._first + first * self.dtype.itemsize,
                )
            yield rows, self.gaussians(rows, first)

    def gaussians(self, rows: Array, first: int = 0) -> Gaussians:
        """Convert stored rows, the first of which has the number `first`, to Gaussians."""
        return to_gaussians(self._path, rows, self._wanted, first)


def save_ply_parts(path: Path, parts: Iterable[Gaussians], count: int, mode: Mode, offset: ArrayLike | None) -> None:
    """Write Gaussians part by part, to the bytes that `save_ply` writes for all of them.

    Parameters
    ----------
    path : Path
    parts : iterable of Gaussians
        With the same degree of spherical harmonics, and `count` Gaussians in all.
    count : int
    mode, offset
        As in `clsplat.formats.save_gaussians`.

    Raises
    ------
    InputError
        As `save_ply`.
    """
    from plyfile import PlyData, PlyElement

    with replacing(path) as out:
        for number, part in enumerate(parts):
            names, table = table_of(path, part)
            if number == 0:
                none = np.empty(0, [(name, "<f4") for name in names])
                ply = PlyData(
                    [PlyElement.describe(none, "vertex")], byte_order="<", comments=comments_of(mode, offset)
                )
                header = str(ply.header).replace("element vertex 0", f"element vertex {count}")
                out.write(f"{header}\n".encode("ascii"))
            out.write(table.tobytes())
