"""A PLY of Gaussians that is read in parts, for scenes that do not fit the memory."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from clsplat.formats.ply import REQUIRED, properties, read_comments, to_gaussians
from clsplat.formats.ply_container import bytes_before, check_size, read_header
from clsplat.formats.validity import read_rows, reading
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

CHUNK = 1 << 16
"""Default number of rows that are read at a time, 16 MB of degree 3."""


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
    begin : int
        Byte of the file at which the rows of a binary one begin.
    coefficients : int
        Number K of the spherical harmonics' coefficients of a Gaussian.
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
        self.coefficients = (len(self._wanted) - len(REQUIRED)) // 3 + 1
        self.begin = header.length + (bytes_before(header) if self.binary else 0)
        self.mode, self.offset = read_comments(header.comments)

    def chunks(self, most: int | None = None) -> Iterator[tuple[Array, Gaussians]]:
        """Yield consecutive rows as they are stored, and as Gaussians, at most `most` at a time (default: `CHUNK`).

        Raises
        ------
        InputError
            If the file cannot be read, or a value is not finite.
        """
        most = CHUNK if most is None else most
        for first in range(0, self.count, most):
            with reading(self._path), open(self._path, "rb") as file:
                file.seek(self.begin + first * self.dtype.itemsize)
                rows = read_rows(self._path, file, self.dtype, min(most, self.count - first))
            yield rows, self.gaussians(rows, first)

    def gaussians(self, rows: Array, first: int = 0) -> Gaussians:
        """Convert stored rows, the first of which has the number `first`, to Gaussians."""
        return to_gaussians(self._path, rows, self._wanted, first)
