"""The .ksplat of mkkellogg's GaussianSplats3D, which is read.

A header, the headers of sections, and the sections: the Gaussians of a section are sorted into buckets of space, and
positions are 16-bit fixed-point numbers relative to the centre of their bucket. Compression level 0 has float32
throughout, 1 has float16 for scales, quaternions wxyz and spherical harmonics, 2 has bytes for the latter. Scales are
no logarithms; colours and opacities are RGBA as bytes. The axes are those of a PLY.
Source: the implementation, https://github.com/mkkellogg/GaussianSplats3D (src/loaders/SplatBuffer.js).
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config import Mode
from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.formats.quantisation import logits_of, logs_of
from clsplat.formats.validity import check_finite, normalised, reading
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

HEADER = np.dtype(
    {
        "names": ["major", "minor", "sections", "count", "level", "sh_low", "sh_high"],
        "formats": ["u1", "u1", "<u4", "<u4", "<u2", "<f4", "<f4"],
        "offsets": [0, 1, 4, 16, 20, 36, 40],
        "itemsize": 4096,
    }
)
"""Layout of the header: version, number of headers of sections, of Gaussians, compression level, range of the
spherical harmonics of level 2."""

SECTION = np.dtype(
    {
        "names": ["count", "room", "bucket", "buckets", "block", "centre", "steps", "full", "partial", "degree"],
        "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
        "itemsize": 1024,
    }
)
"""Layout of a section's header: Gaussians that are there and that have room, Gaussians per bucket, buckets, side of a
bucket in world units, bytes of a centre, steps per half side, full and partial buckets, degree."""

SH_RANGE = 1.5
"""Magnitude of the spherical harmonics of level 2 if the header has zeros."""

CENTRE_SIZE = 12
"""Bytes of the centre of a bucket: three float32."""

DEGREES = (0, 1, 2)
"""Degrees of the spherical harmonics that the format has."""

LEVELS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
"""Types of positions, of scales and quaternions, and of spherical harmonics, by compression level."""


class Section(NamedTuple):
    """A section: its header, the types of a row, and where its parts begin."""

    header: np.void
    row: np.dtype[Any]
    start: int
    end: int


def load_ksplat(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a .ksplat file of version 0.1, of any compression level.

    Returns
    -------
    gaussians, mode, offset
        As in `clsplat.formats.load_gaussians`, of degree 0 to 2; the format stores neither mode nor offset.

    Raises
    ------
    InputError
        If the file cannot be read, is of another format or version, is truncated or damaged, or holds no Gaussian or
        values that are not finite.
    """
    with reading(path):
        data = Path(path).read_bytes()
    header, sections = read_sections(path, data)
    degree = max(int(section.header["degree"]) for section in sections)
    # Values that overflow, and quaternions that are not finite, are rejected at the end.
    with np.errstate(over="ignore", invalid="ignore"):
        parts = [_decode(path, data, header, section, degree) for section in sections]
        whole = Gaussians.concatenate(parts).astype(np.float32)
    return check_finite(path, whole), "classic", np.zeros(3)


def read_sections(path: str | Path, data: bytes) -> tuple[np.void, list[Section]]:
    """Read the headers, and find the sections that hold Gaussians.

    Raises
    ------
    InputError
        If the file is of another format or version, is truncated, or holds no Gaussian.
    """
    if len(data) < HEADER.itemsize:
        raise InputError(f"{path}: expected a .ksplat file, at least {HEADER.itemsize} bytes, found {len(data)}")
    header = np.frombuffer(data, HEADER, 1)[0]
    version = (int(header["major"]), int(header["minor"]))
    if version[0] != 0 or version[1] < 1 or header["level"] >= len(LEVELS):
        raise InputError(
            f"{path}: expected a .ksplat of version 0.1 with compression level 0 to 2, found version "
            f"{version[0]}.{version[1]} with level {header['level']}"
        )
    count = int(header["sections"])
    start = HEADER.itemsize + count * SECTION.itemsize
    if start > len(data):
        raise InputError(
            f"{path}: expected {count} sections, found {len(data)} bytes; the file is truncated or damaged"
        )
    sections = []
    for section in np.frombuffer(data, SECTION, count, HEADER.itemsize):
        row = _row_of(path, int(header["level"]), section)
        begin = start + int(section["partial"]) * 4 + int(section["buckets"]) * CENTRE_SIZE
        end = begin + int(section["room"]) * row.itemsize
        if end > len(data) or section["count"] > section["room"]:
            raise InputError(
                f"{path}: expected {section['count']} Gaussians in {end} bytes as the header of a section declares, "
                f"found {len(data)} bytes; the file is truncated or damaged"
            )
        if section["count"]:
            sections.append(Section(section, row, start, end))
        start = end
    total = sum(int(section.header["count"]) for section in sections)
    if total == 0 or total != header["count"]:
        raise InputError(
            f"{path}: expected {header['count']} Gaussians as the header declares, at least one, found {total}"
        )
    return header, sections


def _row_of(path: str | Path, level: int, section: np.void) -> "np.dtype[Any]":
    """The types of a Gaussian in a section."""
    degree = int(section["degree"])
    if degree not in DEGREES or (level and section["buckets"] and section["centre"] != CENTRE_SIZE):
        raise InputError(
            f"{path}: expected SH degree 0 to 2 and {CENTRE_SIZE} bytes per bucket, found {degree} and "
            f"{section['centre']}; the file is damaged"
        )
    position, shape, sh = LEVELS[level]
    rest = 3 * ((degree + 1) ** 2 - 1)
    columns = [("means", position, 3), ("scales", shape, 3), ("quats", shape, 4), ("rgba", "u1", 4)]
    return np.dtype([*columns, ("sh", sh, rest)])


def _decode(path: str | Path, data: bytes, header: np.void, section: Section, degree: int) -> Gaussians:
    count = int(section.header["count"])
    begin = section.end - int(section.header["room"]) * section.row.itemsize
    rows = np.frombuffer(data, section.row, count, begin)
    means = rows["means"] if header["level"] == 0 else _positions(path, data, section, rows["means"])
    rest = rows["sh"].astype(np.float32)
    if header["level"] == 2:
        low, high = float(header["sh_low"]) or -SH_RANGE, float(header["sh_high"]) or SH_RANGE
        rest = (low + rest / 255 * (high - low)).astype(np.float32)
    sh = np.zeros((count, (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (rows["rgba"][:, :3] / np.float32(255) - np.float32(0.5)) / np.float32(SH_C0)
    for band in range(1, int(section.header["degree"]) + 1):  # band by band, channel by channel
        first, after = band**2, (band + 1) ** 2
        sh[:, first:after] = rest[:, 3 * first - 3 : 3 * after - 3].reshape(count, 3, -1).transpose(0, 2, 1)
    return Gaussians(
        means.astype(np.float32),
        logs_of(rows["scales"].astype(np.float32)),
        normalised(rows["quats"]).astype(np.float32),
        logits_of(rows["rgba"][:, 3]),
        sh,
    )


def _positions(path: str | Path, data: bytes, section: Section, codes: Array) -> Array:
    """Convert 16-bit positions by the centres of their buckets."""
    header = section.header
    full, partial = int(header["full"]), int(header["partial"])
    lengths = np.frombuffer(data, "<u4", partial, section.start).astype(np.int64)
    centres = np.frombuffer(data, "<f4", 3 * int(header["buckets"]), section.start + 4 * partial).reshape(-1, 3)
    rows, size = np.arange(len(codes)), int(header["bucket"])
    held = full * size + int(lengths.sum())
    if held < len(codes) or full + partial > len(centres):
        raise InputError(
            f"{path}: expected a bucket for each of {len(codes)} Gaussians, found {len(centres)} buckets for {held}; "
            "the file is damaged"
        )
    ends = full * size + np.cumsum(lengths)
    bucket = np.where(rows < full * size, rows // max(size, 1), full + np.searchsorted(ends, rows, side="right"))
    steps = int(header["steps"]) or 32767
    return (codes.astype(np.float64) - steps) * (float(header["block"]) / 2 / steps) + centres[bucket]
