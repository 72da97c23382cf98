"""The .compressed.ply of PlayCanvas: chunks of 256 Gaussians, each number relative to the range of its chunk.

A binary PLY with three elements:

* ``chunk``: minima and maxima, as floats, of position, log scale and colour 0.5 + SH_C0 sh;
* ``vertex``: four uint32. Position and log scale have 11, 10 and 11 bits, from the highest. The quaternion wxyz has 2
  bits for the index of its largest component and 10 bits for each of the others. Colour and opacity have 8 bits each;
* ``sh``, if there are spherical harmonics above band 0: bytes ``f_rest_*``, channel by channel, 32 steps per unit
  around 128.

Source: SuperSplat and splat-transform, https://github.com/playcanvas/splat-transform.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.formats.ply import REST_COUNTS, comments_of, read_comments
from clsplat.formats.ply_container import PlyHeader, check_length, read_header
from clsplat.formats.quantisation import (
    SQRT1_2,
    checked,
    clamped,
    from_smallest_three,
    logits_of,
    morton_order,
    opacity_bytes,
    rounded,
    smallest_three,
)
from clsplat.formats.validity import check_finite, read_rows, reading
from clsplat.gaussians import Gaussians

if TYPE_CHECKING:
    from plyfile import PlyElement

Array = NDArray[Any]

CHUNK = 256
"""Number of Gaussians in a chunk."""

RANGES = tuple(
    f"{end}_{name}"
    for group in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in group
)
"""Properties of a chunk, in the order in which they are written. Older files lack the last six, of colours; their
range is then 0 to 1."""

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
"""Properties of a vertex."""

BITS_POSITION = (11, 10, 11)
BITS_ROTATION = (10, 10, 10)
BITS_COLOR = (8, 8, 8)
"""Bits of the three packed numbers, from the highest."""

LOG_SCALE_MAX = 20.0
"""Largest magnitude of a log scale, as in splat-transform. Without the limit, an outlier would coarsen the steps of
its whole chunk."""

SH_STEPS = 32
"""Number of steps per unit of the spherical harmonics; bytes hold -4 to 4."""


def load_compressed_ply(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a .compressed.ply file.

    Returns
    -------
    gaussians, mode, offset
        As in `clsplat.formats.load_gaussians`. Mode and offset are read from comments, as in `load_ply`.

    Raises
    ------
    InputError
        If the file cannot be read, is not a compressed PLY, is truncated, or holds no Gaussian or values that are not
        finite.
    """
    # Values that overflow are rejected at the end.
    with reading(path), open(path, "rb") as file, np.errstate(over="ignore", invalid="ignore"):
        return _load(path, file)


def save_compressed_ply(
    path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None
) -> None:
    """Write Gaussians as a .compressed.ply file, sorted along a Z-order curve so that chunks are small in space.

    Largest rounding errors: positions, log scales and colours half a step of the range of their chunk (2047 steps;
    1023 for y, 255 for colours); quaternions 1/1446 for each component other than the largest; opacities 1/510;
    spherical harmonics 1/64. Log scales beyond ±20 and spherical harmonics beyond ±4 are clamped with a warning. Mode
    and offset become comments, as in `save_ply`.

    Parameters
    ----------
    path, gaussians, mode, offset
        As in `clsplat.formats.save_gaussians`.

    Raises
    ------
    InputError
        If there is no Gaussian, a value is not finite as float32, or the file cannot be written.
    """
    from plyfile import PlyData

    g = checked(path, gaussians)
    comments = comments_of(mode, offset)
    g = g.take(morton_order(g.means))
    n, k = g.sh.shape[:2]
    log_scales = clamped(path, "log_scales", g.log_scales, -LOG_SCALE_MAX, LOG_SCALE_MAX)
    groups = [_to_chunks(x) for x in (g.means, log_scales, 0.5 + SH_C0 * g.sh[:, 0])]
    chunks = np.concatenate([x for low, high, _ in groups for x in (low, high)], axis=1, dtype="<f4")
    means, scales, colors = (units for _, _, units in groups)
    largest, others = smallest_three(g.quats)
    packed = np.stack(
        [
            _pack(means, BITS_POSITION),
            largest.astype(np.uint32) << 30 | _pack(others * SQRT1_2 + 0.5, BITS_ROTATION),
            _pack(scales, BITS_POSITION),
            _pack(colors, BITS_COLOR) << 8 | opacity_bytes(g),
        ],
        axis=1,
    ).astype("<u4")
    elements = [_element(chunks, RANGES, "chunk"), _element(packed, PACKED, "vertex")]
    if k > 1:
        # A byte stands for the middle of its step.
        rest = rounded(path, "sh above band 0", SH_STEPS * g.sh[:, 1:].transpose(0, 2, 1) + 127.5, 255)
        names = tuple(f"f_rest_{i}" for i in range(3 * (k - 1)))
        elements.append(_element(rest.reshape(n, -1), names, "sh"))
    with replacing(path) as out:
        PlyData(elements, byte_order="<", comments=comments).write(out)


def _load(path: str | Path, file: BinaryIO) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    header = read_header(path, file)
    tables = _read_tables(path, file, header)
    chunk, vertex = tables["chunk"], tables["vertex"]
    chunk_of = np.arange(len(vertex)) // CHUNK

    def spread(units: Array, names: tuple[str, ...]) -> Array:
        """Map fractions (N, 3) to the ranges of their chunks."""
        low, high = (np.stack([chunk[f"{end}_{name}"] for name in names], axis=1)[chunk_of] for end in ("min", "max"))
        return low * (1 - units) + high * units

    colors = _unpack(vertex["packed_color"] >> 8, BITS_COLOR)
    if "min_r" in (chunk.dtype.names or ()):
        colors = spread(colors, ("r", "g", "b"))
    others = (_unpack(vertex["packed_rotation"], BITS_ROTATION) - 0.5) / SQRT1_2
    sh = ((colors - 0.5) / SH_C0).astype(np.float32)[:, None]
    if "sh" in tables:
        names = [f"f_rest_{i}" for i in range(len(tables["sh"].dtype.names or ()))]
        rest = np.stack([tables["sh"][name] for name in names], axis=1).reshape(len(sh), 3, -1).transpose(0, 2, 1)
        # The bytes 0 and 255 stand for the ends of the range, the others for the middle of their step.
        values = (np.arange(256) + 0.5) / SH_STEPS - 4
        values[[0, 255]] = -4, 4
        sh = np.concatenate([sh, values.astype(np.float32)[rest]], axis=1)
    gaussians = Gaussians(
        spread(_unpack(vertex["packed_position"], BITS_POSITION), ("x", "y", "z")),
        spread(_unpack(vertex["packed_scale"], BITS_POSITION), ("scale_x", "scale_y", "scale_z")),
        from_smallest_three(vertex["packed_rotation"] >> 30, others),
        logits_of(vertex["packed_color"] & 255),
        sh,
    )
    return check_finite(path, gaussians.astype(np.float32)), *read_comments(header.comments)


def _read_tables(path: str | Path, file: BinaryIO, header: PlyHeader) -> dict[str, Array]:
    """Read the elements as structured arrays, after checking that they are those of a compressed PLY and complete."""
    elements, rows, order = header.elements, header.rows, header.order
    names = {name: {prop.name for prop in element.properties} for name, element in elements.items()}
    colored = not names.get("chunk", set()).isdisjoint(RANGES[12:])
    required = {"chunk": set(RANGES if colored else RANGES[:12]), "vertex": set(PACKED)}
    missing = [f"{e}.{p}" for e, wanted in required.items() for p in sorted(wanted - names.get(e, set()))]
    if missing or order == "=" or not set(names) <= {"chunk", "vertex", "sh"}:
        raise InputError(
            f"{path}: expected a binary compressed PLY with the elements chunk, vertex and maybe sh, found "
            f"{', '.join(names) or 'none'}{' as text' if order == '=' else ''}"
            + (f", which lack {', '.join(missing)}" if missing else "")
        )
    n = rows["vertex"]
    rest = len(names.get("sh", ()))
    if n == 0:
        raise InputError(f"{path}: expected at least one Gaussian, found none")
    if (
        rows["chunk"] != -(-n // CHUNK)
        or rows.get("sh", n) != n
        or rest not in REST_COUNTS
        or names.get("sh", set()) != {f"f_rest_{i}" for i in range(rest)}
    ):
        raise InputError(
            f"{path}: expected a chunk for each {CHUNK} Gaussians and f_rest_* of SH degree 1 to 3 for each, found "
            f"{', '.join(f'{count} rows of {name}' for name, count in rows.items())}, {rest} f_rest_*"
        )
    dtypes = {name: element.dtype(order) for name, element in elements.items()}
    kinds = {"chunk": "f4", "vertex": "u4", "sh": "u1"}
    for name, dtype in dtypes.items():
        if {dtype[i].str[1:] for i in range(len(dtype))} != {kinds[name]}:
            raise InputError(f"{path}: expected properties of {name} to be {kinds[name]}, found {dtype.descr}")
    needed = header.length + sum(rows[name] * dtype.itemsize for name, dtype in dtypes.items())
    check_length(path, needed, n, header.file_size)
    file.seek(header.length)
    return {name: read_rows(path, file, dtype, rows[name]) for name, dtype in dtypes.items()}


def _to_chunks(x: Array) -> tuple[Array, Array, Array]:
    """Compute minima and maxima of the chunks (C, 3), and values (N, 3) as fractions of the range of their chunk."""
    starts = np.arange(0, len(x), CHUNK)
    low, high = np.minimum.reduceat(x, starts), np.maximum.reduceat(x, starts)
    chunk_of = np.arange(len(x)) // CHUNK
    extent = high.astype(np.float64) - low
    return low, high, (x - low[chunk_of].astype(np.float64)) / np.where(extent == 0, 1, extent)[chunk_of]


def _pack(fractions: Array, bits: tuple[int, ...]) -> Array:
    """Pack fractions (N, 3) to uint32 (N,), the first component in the highest bits."""
    word = np.zeros(len(fractions), np.uint32)
    for column, width in enumerate(bits):
        word = word << width | np.rint(fractions[:, column] * (2**width - 1)).astype(np.uint32)
    return word


def _unpack(words: Array, bits: tuple[int, ...]) -> Array:
    """Unpack fractions (N, 3): the inverse of `_pack`; higher bits are ignored."""
    shifts = [sum(bits[column + 1 :]) for column in range(3)]
    fields = [(words >> shift & (2**width - 1)) / (2**width - 1) for shift, width in zip(shifts, bits, strict=True)]
    return np.stack(fields, axis=1)


def _element(table: Array, names: tuple[str, ...], element: str) -> "PlyElement":
    """Make an element of a PLY from a table (rows, columns)."""
    from plyfile import PlyElement

    table = np.ascontiguousarray(table)
    rows = table.view([(name, table.dtype.str) for name in names])[:, 0]
    return PlyElement.describe(rows, element)
