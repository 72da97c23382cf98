"""The container of .spz: header, compression of its planes, and the axes that a record of Adobe may declare.

Versions 2 and 3 are one stream of gzip: header, planes, records. Version 4 is a header of 32 bytes, records, a table
with the compressed and plain size of each plane, and a stream of Zstandard for each plane. Records of vendors have a
type, a length, and content.
Source: the description next to the implementation, https://github.com/nianticlabs/spz, and its folder extensions.
"""

import gzip
import struct
import warnings
import zlib
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

from clsplat.constants import SH_DEGREE_MAX
from clsplat.errors import InputError
from clsplat.formats.axes import LEFT_UP_FORWARD, RIGHT_UP_BACK
from clsplat.formats.quantisation import check_expansion, file_size
from clsplat.formats.validity import reading

Axes = Literal["rub", "rdf"]
Version = Literal[3, 4]

MAGIC = 0x5053474E
HEADER = struct.Struct("<IIIBBBB")
"""Layout of the header: magic, version, number of Gaussians, SH degree, fractional bits, flags, 0 (in version 4 the
number of streams)."""

HEADER_SIZE = 32
"""Bytes of the header of version 4, of which those after HEADER are the start of the table, uint32, and zeros."""

TABLE_ROW = struct.Struct("<QQ")
"""Layout of a row of the table of version 4: compressed and plain size."""

ANTIALIASED = 1
"""Flag of scenes trained in the antialiased mode."""

EXTENDED = 2
"""Flag of files with records of vendors."""

RECORD = struct.Struct("<II")
"""Layout of the start of a record: type, and bytes of its content."""

AXES_RECORD = 0xADBE0003
"""Type of the record SPZ_ADOBE_coordinate_system, whose content is a key of AXES."""

AXES: dict[int, tuple[float, float, float]] = {
    0: RIGHT_UP_BACK,
    1: (-1.0, 1.0, -1.0),
    4: RIGHT_UP_BACK,
    6: (1.0, 1.0, 1.0),
    7: LEFT_UP_FORWARD,
}
"""Signs by which coordinates change to or from right, down, forward: unspecified; left, down, back; right, up, back;
right, down, forward; left, up, forward. The library's other axes are left-handed, or have another axis upwards."""

RDF = 6
"""Key of AXES of the axes of a PLY: right, down, forward."""

GZIP_LEVEL = 6
"""Compression level of gzip, 1 to 9. Measurement: docs/formats.md."""

ZSTD_LEVEL = 12
"""Compression level of Zstandard, 1 to 22. Measurement: docs/formats.md."""


class Header(NamedTuple):
    """Values of the header. axes: the key of `AXES` in a record, None if the file declares no axes."""

    version: int
    n: int
    degree: int
    bits: int
    flags: int
    axes: int | None = None


def plane_sizes(n: int, degree: int, version: int) -> list[int]:
    """Compute the bytes of each plane before compression, in the order of the file."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [n * width for width in (9, 1, 3, 3, 3 if version == 2 else 4, rest)]


def read_container(path: str | Path) -> tuple[Header, list[bytes]]:
    """Read the header and the planes of an .spz file of version 2, 3 or 4.

    Raises
    ------
    InputError
        If the file cannot be read, is of another format or version, is truncated, holds no Gaussian, declares axes
        that clsplat does not know, or declares more than a file of its size can hold.
    """
    with reading(path), open(path, "rb") as file:
        return unpack(path, file, file_size(path))


def unpack(path: str | Path, file: BinaryIO, size: int) -> tuple[Header, list[bytes]]:
    """Read the header and the planes of an .spz of `size` bytes from an open file, as `read_container` does."""
    head = file.read(4)
    file.seek(0)
    try:
        if head[:2] == b"\x1f\x8b":
            return _read_gzip(path, file, size)
        if head == struct.pack("<I", MAGIC):
            return _read_zstd(path, file)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise InputError(f"cannot read {path}: {error}; is the file truncated?") from error
    raise InputError(f"{path}: expected an .spz file, which begins as gzip or with NGSP, found {head!r}")


def write_container(out: BinaryIO, header: Header, planes: list[bytes]) -> None:
    """Write planes with a header of version 3 or 4, and in version 4 a record of `header.axes` unless it is None."""
    record = b""
    if header.version == 4 and header.axes is not None:  # Niantic's library reads no records of version 3
        record = RECORD.pack(AXES_RECORD, 4) + struct.pack("<I", header.axes)
    flags = header.flags | (EXTENDED if record else 0)
    planes = [plane for plane in planes if plane]
    last = len(planes) if header.version == 4 else 0
    head = HEADER.pack(MAGIC, header.version, header.n, header.degree, header.bits, flags, last)
    if header.version == 3:
        with gzip.GzipFile("", "wb", GZIP_LEVEL, out, mtime=0) as packed:
            packed.write(b"".join([head, *planes]))
        return
    import zstandard

    streams = [zstandard.ZstdCompressor(ZSTD_LEVEL).compress(plane) for plane in planes]
    start = struct.pack("<I", HEADER_SIZE + len(record))
    table = [TABLE_ROW.pack(len(stream), len(plane)) for stream, plane in zip(streams, planes, strict=True)]
    out.write(b"".join([(head + start).ljust(HEADER_SIZE, b"\0"), record, *table, *streams]))


def _read_gzip(path: str | Path, file: BinaryIO, size: int) -> tuple[Header, list[bytes]]:
    with gzip.GzipFile(fileobj=file) as packed:
        header, _ = _parse_header(path, packed.read(HEADER.size), (2, 3))
        sizes = plane_sizes(header.n, header.degree, header.version)
        check_expansion(path, sum(sizes), size)
        planes = [packed.read(count) for count in sizes]
        if [len(plane) for plane in planes] != sizes:
            raise EOFError(f"expected {sum(sizes)} bytes for {header.n} Gaussians, found {sum(map(len, planes))}")
        # Reading to the end also verifies the checksum.
        rest = packed.read(RECORDS_MAX) if header.flags & EXTENDED else packed.read(1)
        if rest and not header.flags & EXTENDED:
            raise InputError(
                f"{path}: expected {header.n} Gaussians as the header declares, found more bytes than they take"
            )
    return _with_axes(path, header, rest), planes


RECORDS_MAX = 1 << 16
"""Bytes of records that are searched for axes. The records known today have 12 to 200 bytes."""


def _read_zstd(path: str | Path, file: BinaryIO) -> tuple[Header, list[bytes]]:
    import zstandard

    data = file.read()
    header, streams = _parse_header(path, data, (4,))
    sizes = [size for size in plane_sizes(header.n, header.degree, header.version) if size]
    check_expansion(path, sum(sizes), len(data))
    try:
        (start,) = struct.unpack_from("<I", data, HEADER.size)
        table = [TABLE_ROW.unpack_from(data, start + TABLE_ROW.size * i) for i in range(streams)]
    except struct.error as error:
        raise EOFError("the table of streams is missing") from error
    if [plain for _, plain in table] != sizes:
        raise InputError(
            f"{path}: expected streams of {sizes} bytes for {header.n} Gaussians of degree {header.degree}, "
            f"found {[plain for _, plain in table]}"
        )
    planes, at = [], start + TABLE_ROW.size * streams
    for length, plain in table:
        packed = data[at : at + length]
        try:
            # zstandard allocates the size that a frame declares, whatever max_output_size is; -1 means no
            # declaration.
            if zstandard.frame_content_size(packed) not in (-1, plain):
                raise EOFError("a stream declares another size than the table of streams")
            plane = zstandard.ZstdDecompressor().decompress(packed, max_output_size=plain)
        except zstandard.ZstdError as error:
            raise EOFError(str(error)) from error
        if len(plane) != plain:
            raise EOFError(f"a stream has {len(plane)} bytes instead of {plain}")
        planes.append(plane)
        at += length
    return _with_axes(path, header, data[HEADER_SIZE:start]), [*planes, b""][:6]


def _parse_header(path: str | Path, header: bytes, versions: tuple[int, ...]) -> tuple[Header, int]:
    """Read the header, and its last byte."""
    if len(header) < HEADER.size:
        raise EOFError(f"the header has only {len(header)} bytes")
    magic, version, n, degree, bits, flags, last = HEADER.unpack_from(header)
    if magic != MAGIC:
        raise InputError(f"{path}: expected an .spz file, whose header begins with NGSP, found {header[:4]!r}")
    if version not in versions:
        raise InputError(f"{path}: expected .spz of version 2, 3 or 4, found version {version}")
    if n == 0:
        raise InputError(f"{path}: expected at least one Gaussian, found none")
    if degree > SH_DEGREE_MAX + 1 or bits > 23:
        raise InputError(f"{path}: expected SH degree 0 to 4 and 0 to 23 fractional bits, found {degree} and {bits}")
    return Header(version, n, degree, bits, flags), last


def _with_axes(path: str | Path, header: Header, records: bytes) -> Header:
    """Find the axes among the records of vendors; warn if a file with records does not declare them."""
    if not header.flags & EXTENDED:
        return header
    at = 0
    while at + RECORD.size <= len(records):
        kind, length = RECORD.unpack_from(records, at)
        content = records[at + RECORD.size : at + RECORD.size + length]
        if kind == AXES_RECORD and len(content) == 4:
            (axes,) = struct.unpack("<I", content)
            if axes not in AXES:
                raise InputError(
                    f"{path}: expected right-handed axes with y upwards or downwards, found axes {axes} of "
                    "SPZ_ADOBE_coordinate_system; export it with the axes right, up, back"
                )
            return header._replace(axes=axes)
        at += RECORD.size + length
    warnings.warn(
        f"{path}: vendor-specific records are ignored; axes are assumed to be right, up, back", stacklevel=2
    )
    return header
