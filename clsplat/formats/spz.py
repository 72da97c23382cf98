"""The .spz of Niantic: planes of 8-bit and 24-bit numbers, compressed.

Version 3 (gzip) is written, which all readers support; versions 2 and 4 (Zstandard) are read as well. The header is
followed by these planes, each for all Gaussians:

* positions: 3 signed 24-bit fixed-point numbers;
* opacities: 255 times the opacity;
* colours: 38.25 sh + 127.5;
* log scales: 16 times the log scale, + 160;
* quaternions: 4 bytes with the index of the largest component of xyzw, and sign and 9-bit magnitude of the others; in
  version 2, 3 bytes xyz;
* spherical harmonics above band 0: 128 times the coefficient, + 128; coefficient by coefficient, RGB within each.

The axes of the file are right, up, back; those of a PLY are right, down, forward.
Source: the description next to the implementation, https://github.com/nianticlabs/spz.
"""

import gzip
import math
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import SH_DEGREE_MAX
from clsplat.errors import InputError
from clsplat.formats.codebook import PALETTE_SHARE, shared_rows
from clsplat.formats.quantisation import (
    SQRT1_2,
    check_expansion,
    checked,
    file_size,
    from_smallest_three,
    logits_of,
    morton_order,
    opacity_bytes,
    rounded,
    smallest_three,
    warn_lost,
)
from clsplat.formats.validity import normalised, reading
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

MAGIC = 0x5053474E
HEADER = struct.Struct("<IIIBBBB")
"""Layout of the header: magic, version, number of Gaussians, SH degree, fractional bits, flags, 0 (in version 4 the
number of streams)."""

ANTIALIASED = 1
"""Flag of scenes trained in the antialiased mode."""

EXTENDED = 2
"""Flag of files with vendor-specific records."""

GZIP_LEVEL = 6
"""Compression level of gzip, 1 to 9. Measurement: docs/formats.md."""

SIGMA_STEPS = 5
"""Number of steps of the positions per smallest standard deviation of the median Gaussian, before it is rounded up to
a whole number of bits. Measurement: docs/formats.md."""

COLOR = (0.15 * 255, 127.5)
LOG_SCALE = (16.0, 160.0)
SH = (128.0, 128.0)
"""Factor and summand that convert a value to a byte."""

SH_STEP = 4
"""Step of the bytes of the bands above 0, counted from 128; a coarser step compresses better. Other writers use 8 in
band 1 and 16 above, which is coarser than the coefficients of most scenes. Shared bands have steps of 1, since their
repetitions take few bytes. Measurement: docs/formats.md."""

SH_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Signs by which the coefficients change when y and z change sign: the parity of the basis functions in y and z,
which are y, z, x; xy, yz, zz, xz, xx; y, xyz, y, z, x, zxx, x."""


def load_spz(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from an .spz file of version 2, 3 or 4.

    Returns
    -------
    gaussians, mode, offset
        As in `clsplat.formats.load_gaussians`. The Gaussians are in the axes of a PLY, so that y and z have the
        opposite sign of those in the file. The format does not store the offset.

    Raises
    ------
    InputError
        If the file cannot be read, is of another format or version, is truncated, holds no Gaussian, or declares more
        than a file of its size can hold.
    """
    with reading(path), open(path, "rb") as file:
        head = file.read(4)
        file.seek(0)
        try:
            if head[:2] == b"\x1f\x8b":
                return _load_gzip(path, file)
            if head == struct.pack("<I", MAGIC):
                return _load_zstd(path, file)
        except (EOFError, zlib.error) as error:
            raise InputError(f"cannot read {path}: {error}; is the file truncated?") from error
    raise InputError(f"{path}: expected an .spz file, which begins as gzip or with NGSP, found {head!r}")


def save_spz(path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Write Gaussians as an .spz file of version 3.

    The Gaussians are sorted along a Z-order curve, which compresses better. Those that share their bands above 0 come
    one after the other, if that is so for three on average. Largest rounding errors: positions half of 2^-b units (b:
    see `fractional_bits`), opacities 1/510, sh of band 0 1/76.5, log scales 1/32, quaternions 1/1445 for each
    component other than the largest, spherical harmonics above band 0 1/64 (shared ones 1/256). Ranges: sh of band 0
    within ±3.33, log scales from -10 to 5.9375, spherical harmonics above band 0 within ±1; values outside are
    clamped with a warning. The offset is lost with a warning.

    Parameters
    ----------
    path, gaussians, mode, offset
        As in `clsplat.formats.save_gaussians`.

    Raises
    ------
    InputError
        If there is no Gaussian, a value is not finite as float32, a position is too large for 24 bits, or the file
        cannot be written.
    """
    g = _turned(checked(path, gaussians))
    g = g.take(morton_order(g.means))
    shared = shared_rows(g.sh[:, 1:].reshape(len(g), -1), len(g) // PALETTE_SHARE) if g.sh_degree else None
    if shared is not None:  # equal bands next to each other
        g = g.take(np.argsort(shared[1], kind="stable"))
    warn_lost(path, offset=offset)
    n = len(g)
    bits = fractional_bits(path, g)
    fixed = np.rint(g.means.astype(np.float64) * 2.0**bits).astype("<i4")
    planes = [
        fixed.view(np.uint8).reshape(n, 3, 4)[:, :, :3],
        opacity_bytes(g),
        rounded(path, "sh of band 0", COLOR[0] * g.sh[:, 0] + COLOR[1], 255),
        rounded(path, "log_scales", LOG_SCALE[0] * g.log_scales + LOG_SCALE[1], 255),
        _pack(g.quats),
        _sh_bytes(path, g.sh[:, 1:], SH_STEP if shared is None else 1),
    ]
    flags = ANTIALIASED if mode == "antialiased" else 0
    with replacing(path) as out, gzip.GzipFile("", "wb", GZIP_LEVEL, out, mtime=0) as packed:
        packed.write(HEADER.pack(MAGIC, 3, n, g.sh_degree, bits, flags, 0))
        for plane in planes:
            packed.write(np.ascontiguousarray(plane).tobytes())


def fractional_bits(path: str | Path, gaussians: Gaussians) -> int:
    """Choose the number of fractional bits of the positions, 0 to 23.

    The number follows from the size of the Gaussians (SIGMA_STEPS), and is smaller if the scene would not fit into 24
    bits.

    Raises
    ------
    InputError
        If a coordinate does not fit into 24 bits even without fractional bits.
    """
    finest = float(np.median(gaussians.log_scales.min(axis=1)))
    wanted = math.ceil(math.log2(SIGMA_STEPS) - finest / math.log(2))
    largest = float(np.abs(gaussians.means).max())
    room = 23 - math.frexp(largest * (1 + 2.0**-22))[1]  # a rounded coordinate must stay below 2^23
    if room < 0:
        raise InputError(
            f"{path}: expected coordinates within ±{2**23} units, found {largest:g}; move the scene's origin nearer"
        )
    return max(0, min(wanted, room, 23))


def _load_gzip(path: str | Path, file: BinaryIO) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    size = file_size(path)
    with gzip.GzipFile(fileobj=file) as packed:
        header = packed.read(HEADER.size)
        version, n, degree, bits, flags, _ = _parse_header(path, header, (2, 3))
        sizes = plane_sizes(n, degree, version)
        check_expansion(path, sum(sizes), size)
        planes = [packed.read(count) for count in sizes]
        if [len(plane) for plane in planes] != sizes:
            raise EOFError(f"expected {sum(sizes)} bytes for {n} Gaussians, found {sum(map(len, planes))}")
        if not flags & EXTENDED and packed.read(1):  # reading to the end also verifies the checksum
            raise InputError(
                f"{path}: expected {n} Gaussians as the header declares, found more bytes than they take"
            )
    return _decode(path, planes, (version, n, degree, bits, flags))


def _load_zstd(path: str | Path, file: BinaryIO) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read version 4: header of 32 bytes, vendor-specific records, table of compressed and plain sizes, planes."""
    import zstandard

    data = file.read()
    version, n, degree, bits, flags, streams = _parse_header(path, data, (4,))
    sizes = [size for size in plane_sizes(n, degree, version) if size]
    check_expansion(path, sum(sizes), len(data))
    try:
        (start,) = struct.unpack_from("<I", data, HEADER.size)
        table = [struct.unpack_from("<QQ", data, start + 16 * i) for i in range(streams)]
    except struct.error as error:
        raise EOFError("the table of streams is missing") from error
    if [plain for _, plain in table] != sizes:
        raise InputError(
            f"{path}: expected streams of {sizes} bytes for {n} Gaussians of degree {degree}, "
            f"found {[plain for _, plain in table]}"
        )
    planes, at = [], start + 16 * streams
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
    return _decode(path, [*planes, b""][:6], (version, n, degree, bits, flags))


def _parse_header(path: str | Path, header: bytes, versions: tuple[int, ...]) -> tuple[int, int, int, int, int, int]:
    """Read version, number of Gaussians, SH degree, fractional bits, flags and last byte from the header."""
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
    if flags & EXTENDED:
        warnings.warn(
            f"{path}: vendor-specific records are ignored; axes are assumed to be right, up, back", stacklevel=2
        )
    return version, n, degree, bits, flags, last


def plane_sizes(n: int, degree: int, version: int) -> list[int]:
    """Compute the bytes of each plane before compression, in the order of the file."""
    rest = 3 * ((degree + 1) ** 2 - 1)
    return [n * width for width in (9, 1, 3, 3, 3 if version == 2 else 4, rest)]


def _decode(
    path: str | Path, planes: list[bytes], header: tuple[int, int, int, int, int]
) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    version, n, degree, bits, flags = header
    positions, opacities, colors, scales, quats, rest = (
        np.frombuffer(plane, np.uint8).reshape(n, size // n)
        for plane, size in zip(planes, plane_sizes(n, degree, version), strict=True)
    )
    fixed = np.zeros((n, 3, 4), np.uint8)
    fixed[:, :, 1:] = positions.reshape(n, 3, 3)  # fills the upper 24 bits; the division by 256 below keeps the sign
    sh0 = (colors.astype(np.float32) - COLOR[1]) / COLOR[0]
    sh = np.concatenate([sh0, (rest.astype(np.float32) - SH[1]) / SH[0]], axis=1).reshape(n, -1, 3)
    if degree > SH_DEGREE_MAX:
        warnings.warn(f"{path}: spherical harmonics of degree {degree} are cut to {SH_DEGREE_MAX}", stacklevel=2)
        sh = sh[:, : (SH_DEGREE_MAX + 1) ** 2]
    gaussians = Gaussians(
        fixed.view("<i4")[:, :, 0] / 256 / 2.0**bits,
        (scales.astype(np.float32) - LOG_SCALE[1]) / LOG_SCALE[0],
        _unpack_xyz(quats) if version == 2 else _unpack(quats),
        logits_of(opacities[:, 0]),
        sh,
    )
    return _turned(gaussians).astype(np.float32), "antialiased" if flags & ANTIALIASED else "classic", np.zeros(3)


def _sh_bytes(path: str | Path, sh: Array, step: int) -> Array:
    """Convert coefficients (N, K, 3) to bytes (N, 3 K): 128 plus a multiple of `step`, which keeps 0 exact."""
    steps = np.rint(SH[0] / step * sh) * step
    return rounded(path, "sh above band 0", steps + SH[1], 255).reshape(len(sh), -1)


def _pack(quats: Array) -> Array:
    """Pack quaternions wxyz (N, 4) to bytes (N, 4): index of the largest of xyzw in the highest bits, the others."""
    largest, others = smallest_three(np.roll(quats, -1, axis=1))
    fields = (others < 0).astype(np.uint32) << 9 | np.rint(np.abs(others) / SQRT1_2 * 511).astype(np.uint32)
    words = largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return words.astype("<u4").view(np.uint8).reshape(-1, 4)


def _unpack(packed: Array) -> Array:
    """Unpack quaternions wxyz (N, 4): the inverse of `_pack`."""
    words = np.ascontiguousarray(packed).view("<u4")
    fields = words >> np.array([20, 10, 0], np.uint32)
    others = np.where(fields & 512, -1, 1) * (fields & 511) * (SQRT1_2 / 511)
    return np.roll(from_smallest_three(words[:, 0] >> 30, others), 1, axis=1)


def _unpack_xyz(packed: Array) -> Array:
    """Unpack quaternions wxyz (N, 4) of version 2: xyz as bytes 127.5 q + 127.5, w positive."""
    xyz = packed / 127.5 - 1
    w = np.sqrt(np.maximum(1 - np.einsum("ni,ni->n", xyz, xyz), 0))
    return normalised(np.concatenate([w[:, None], xyz], axis=1))


def _turned(gaussians: Gaussians) -> Gaussians:
    """Turn a scene by 180 degrees about x: from the axes right, down, forward to right, up, back, or back again."""
    signs = np.array([1.0, -1.0, -1.0], np.float32)
    return Gaussians(
        gaussians.means * signs,
        gaussians.log_scales,
        gaussians.quats * np.array([1.0, 1.0, -1.0, -1.0], np.float32),
        gaussians.logit_opacities,
        gaussians.sh * SH_SIGNS[: gaussians.sh.shape[1], None],
    )
