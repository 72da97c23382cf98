"""The PLY container: header and rows of its elements, of any content.

Gaussians in a PLY are `clsplat.formats.ply` and `clsplat.formats.compressed_ply`. plyfile parses headers; rows are
read by NumPy, once the size of the file is known to suffice.
"""

import io
import os
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.formats.validity import read_rows

if TYPE_CHECKING:
    from plyfile import PlyElement

Array = NDArray[Any]

HEADER_MAX = 1 << 20
"""Number of bytes in which the end of the header is searched. The header of a scene of SH degree 3 has 1.5 kB."""

POSITION = ("x", "y", "z")
"""Properties of a position."""


class PlyHeader(NamedTuple):
    """Declarations in the header of a PLY.

    elements: elements with their properties, by name, in the order of the file; rows: number of rows of each; order:
    byte order, "<" or ">", or "=" for ASCII; comments: text of the comments; length: bytes of the header; file_size:
    bytes of the file.
    """

    elements: dict[str, "PlyElement"]
    rows: dict[str, int]
    order: str
    comments: list[str]
    length: int
    file_size: int


def read_header(path: str | Path, file: BinaryIO) -> PlyHeader:
    """Read and parse the header of a PLY file.

    Raises
    ------
    InputError
        If the file is not a PLY, or its header is truncated or malformed.
    """
    head = file.read(HEADER_MAX)
    size = file.seek(0, io.SEEK_END)
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", head)
    if first is None:
        raise InputError(f"{path}: expected a PLY file, whose first line is 'ply', found {head[:12]!r}")
    end = re.search(re.escape(first[1]) + rb"end_header[ \t]*" + re.escape(first[1]), head)
    if end is None:
        raise InputError(f"{path}: expected a PLY header that ends with 'end_header', found none; is it truncated?")
    return _parse(path, head[: end.end()], size)


def _parse(path: str | Path, header: bytes, file_size: int) -> PlyHeader:
    """Parse a header by plyfile, with all numbers of rows set to 0.

    plyfile would allocate the declared number of rows, and would reject comments that are not ASCII.
    """
    from plyfile import PlyData, PlyParseError

    lines, counts, comments = [], [], []
    try:
        for line in header.splitlines():  # splits bytes: splitting a str would also split comments in UTF-8
            words = [word.decode("latin-1") for word in line.split()]
            if words[:1] in (["comment"], ["obj_info"]):
                comments.append(" ".join(words[1:]))
                continue
            if words[:1] == ["element"] and len(words) == 3:
                counts.append(int(words[2]))
                words[2] = "0"
            lines.append(" ".join(words))
        if min(counts, default=0) < 0:
            raise ValueError("a negative number of rows")
        ply = PlyData.read(io.BytesIO("\n".join([*lines, ""]).encode()))
        elements = {element.name: element for element in ply.elements}
        rows = dict(zip(elements, counts, strict=True))
    except (PlyParseError, ValueError) as error:
        raise InputError(f"cannot read {path}: malformed PLY header: {error}") from error
    return PlyHeader(elements, rows, "=" if ply.text else ply.byte_order, comments, len(header), file_size)


def check_length(path: str | Path, needed: int, count: int, size: int) -> None:
    """Raise an InputError if a file of `size` bytes is shorter than the `needed` bytes for `count` Gaussians."""
    if size < needed:
        raise InputError(
            f"{path}: expected at least {needed} bytes for the {count} Gaussians its header declares, found {size}; "
            "the file is truncated or damaged"
        )


def read_vertices(path: str | Path, file: BinaryIO, header: PlyHeader) -> Array:
    """Read the rows of the element ``vertex`` as a structured array (N,), of float64 if the file is ASCII.

    Raises
    ------
    InputError
        If the file is shorter than declared, has list properties before the last vertex, or has malformed rows.
    """
    check_size(path, header)
    file.seek(header.length)
    before, vertex = list(header.elements).index("vertex"), header.elements["vertex"]
    counts = list(header.rows.values())
    if header.order == "=":
        names = [prop.name for prop in vertex.properties]
        return _read_text(path, file, sum(counts[:before]), counts[before], names)
    file.seek(bytes_before(header), os.SEEK_CUR)
    return read_rows(path, file, vertex.dtype(header.order), counts[before])


def bytes_before(header: PlyHeader) -> int:
    """Bytes between the header of a binary file and its first vertex."""
    names = list(header.elements)
    before = names[: names.index("vertex")]
    return sum(header.rows[name] * header.elements[name].dtype().itemsize for name in before)


def read_points(path: str | Path, file: BinaryIO) -> Array:
    """Read the vertices of any PLY file: a structured array (N,) of the declared types, with x, y and z.

    Raises
    ------
    InputError
        If the file has no positions, is truncated or malformed, or has numbers beyond their declared type.
    """
    header = read_header(path, file)
    vertex = header.elements.get("vertex")
    names = [] if vertex is None else [prop.name for prop in vertex.properties]
    missing = set(POSITION) - set(names)
    if vertex is None or missing:
        raise InputError(f"{path}: expected points with x, y and z, found no {', '.join(sorted(missing))}")
    data = read_vertices(path, file, header)
    if header.order != "=":
        return data
    with np.errstate(over="ignore", invalid="ignore"):
        typed = data.astype(vertex.dtype())
    for name in names:
        if typed[name].dtype.kind in "iu" and (typed[name] != data[name]).any():
            raise InputError(f"{path}: expected {name} within {typed[name].dtype} as declared, found others")
    return typed


def check_size(path: str | Path, header: PlyHeader) -> None:
    """Check that the file has the bytes that its header declares, up to the last vertex."""
    from plyfile import PlyListProperty

    needed = header.length
    for name, element in header.elements.items():
        count = header.rows[name]
        if header.order == "=":
            needed += count * 2 * len(element.properties)  # a digit and a separator for each value
        elif any(isinstance(prop, PlyListProperty) for prop in element.properties):
            raise InputError(f"{path}: expected no list property up to the Gaussians, found one in '{name}'")
        else:
            needed += count * element.dtype().itemsize
        if name == "vertex":
            break
    if header.order == "=":
        needed -= 1  # the end of the last line may be missing
    check_length(path, needed, count, header.file_size)


def _read_text(path: str | Path, file: BinaryIO, skip: int, count: int, names: list[str]) -> Array:
    """Read `count` rows of an ASCII file, after `skip` other rows, as a structured array of float64."""
    if not count:  # NumPy would give the empty array one column
        return np.empty(0, [(name, np.float64) for name in names])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about empty lines; the shape is checked below
            rows = np.loadtxt(
                io.TextIOWrapper(file, "latin-1"), comments=None, skiprows=skip, max_rows=count, ndmin=2
            )
    except ValueError as error:
        raise InputError(f"cannot read {path}: expected rows of {len(names)} numbers: {error}") from error
    if rows.shape != (count, len(names)):
        raise InputError(f"{path}: expected {count} rows of {len(names)} numbers, found {rows.shape}")
    return rows.view([(name, np.float64) for name in names])[:, 0]
