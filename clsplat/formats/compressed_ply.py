"""The .compressed.ply of PlayCanvas: chunks of 256 Gaussians, each number relative to its chunk's range.

A binary PLY of three elements: ``chunk`` (float minima and maxima of position, log scale and colour 0.5 + SH_C0 sh),
``vertex`` (four uint32: position and log scale as 11, 10 and 11 bits from the highest; the quaternion wxyz as 2 bits
for the index of its largest component and 10 bits for each of the others; colour and opacity as 8 bits each) and,
where there are spherical harmonics, ``sh`` (bytes ``f_rest_*``, channel by channel, 32 steps for a unit around 128).
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
from clsplat.formats.ply import REST_COUNTS, comments_of, parse_header, read_comments, read_header
from clsplat.formats.quantisation import (
    SQRT1_2,
    check_finite,
    checked,
    clamped,
    from_smallest_three,
    logits_of,
    morton_order,
    opacity_bytes,
    rounded,
    smallest_three,
)
from clsplat.gaussians import Gaussians

if TYPE_CHECKING:
    from plyfile import PlyElement

Array = NDArray[Any]

CHUNK = 256
"""Gaussians that share a range."""

RANGES = tuple(
    f"{end}_{name}"
    for group in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in group
)
"""Properties of a chunk, in the order in which they are written; older files lack the last six, for colours,
whose range is 0..1 there."""

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

BITS_POSITION = (11, 10, 11)
BITS_ROTATION = (10, 10, 10)
BITS_COLOR = (8, 8, 8)

LOG_SCALE_MAX = 20.0
"""Log scales are clamped to ± this, as by splat-transform: an outlier would widen the steps of its whole chunk."""

SH_STEPS = 32
"""Steps for a unit of spherical harmonics: bytes hold -4 to 4."""


def load_compressed_ply(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a .compressed.ply file.

    Returns
    -------
    gaussians : Gaussians
        float32.
    mode : {"classic", "antialiased"}
        What the file's comments say, as in a PLY of floats.
    offset : (3,) float64
        What the file's comments say was subtracted from the world's coordinates; zeros if they do not.

    Raises
    ------
    InputError
        If the file cannot be read, is no compressed PLY, is truncated, or holds no Gaussian or values that are not
        finite.
    """
    try:
        # What is not finite in the end is refused then.
        with open(path, "rb") as file, np.errstate(over="ignore", invalid="ignore"):
            return _load(path, file)
    except OSError as error:
        raise InputError(f"{path}: expected a readable PLY file, found: {error.strerror or error}") from error


def save_compressed_ply(
    path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None
) -> None:
    """Write Gaussians as a .compressed.ply file, sorted along a Z-order curve so that chunks are small in space.

    Rounded are positions, log scales and colours to half a step of their chunk's range (2047 steps; 1023 for y, 255
    for colours), quaternions to 1/1446 for each component but the largest, opacities to 1/510, spherical harmonics
    to 1/64. Clamped, with a warning, are log scales beyond ±20 and spherical harmonics beyond ±4. Mode and offset
    are comments, as in a PLY of floats.

    Parameters
    ----------
    path : str or Path
        The file; its folder must exist.
    gaussians : Gaussians
        At least one, finite.
    mode : {"classic", "antialiased"}
        The rendering mode the scene was trained for.
    offset : (3,) array_like, optional
        What was subtracted from the world's coordinates, in world units.

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
        # Bytes are read at the middle of their step.
        rest = rounded(path, "sh above band 0", SH_STEPS * g.sh[:, 1:].transpose(0, 2, 1) + 127.5, 255)
        names = tuple(f"f_rest_{i}" for i in range(3 * (k - 1)))
        elements.append(_element(rest.reshape(n, -1), names, "sh"))
    with replacing(path) as out:
        PlyData(elements, byte_order="<", comments=comments).write(out)


def _load(path: str | Path, file: BinaryIO) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    header, size = read_header(path, file)
    elements, counts, order, comments = parse_header(path, header)
    tables = _read(path, file, elements, counts, (order, len(header), size))
    chunk, vertex = tables["chunk"], tables["vertex"]
    of = np.arange(len(vertex)) // CHUNK

    def spread(units: Array, names: tuple[str, ...]) -> Array:
        low, high = (np.stack([chunk[f"{end}_{name}"] for name in names], axis=1)[of] for end in ("min", "max"))
        return low * (1 - units) + high * units

    colors = _unpack(vertex["packed_color"] >> 8, BITS_COLOR)
    if "min_r" in (chunk.dtype.names or ()):
        colors = spread(colors, ("r", "g", "b"))
    others = (_unpack(vertex["packed_rotation"], BITS_ROTATION) - 0.5) / SQRT1_2
    sh = ((colors - 0.5) / SH_C0).astype(np.float32)[:, None]
    if "sh" in tables:
        names = [f"f_rest_{i}" for i in range(len(tables["sh"].dtype.names or ()))]
        rest = np.stack([tables["sh"][name] for name in names], axis=1).reshape(len(sh), 3, -1).transpose(0, 2, 1)
        # The outermost bytes stand for the ends, the others for the middle of their step.
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
    return check_finite(path, gaussians.astype(np.float32)), *read_comments(comments)


def _read(
    path: str | Path,
    file: BinaryIO,
    elements: dict[str, "PlyElement"],
    counts: list[int],
    place: tuple[str, int, int],
) -> dict[str, Array]:
    """The elements as structured arrays, once it is sure that they are those of a compressed PLY and are there."""
    order, at, size = place
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
    rows = dict(zip(elements, counts, strict=True))
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
    needed = at + sum(rows[name] * dtype.itemsize for name, dtype in dtypes.items())
    if size < needed:
        raise InputError(
            f"{path}: expected at least {needed} bytes for the {n} Gaussians its header declares, found {size}; "
            "the file is truncated or damaged"
        )
    file.seek(at)
    return {name: np.fromfile(file, dtype, rows[name]) for name, dtype in dtypes.items()}


def _to_chunks(x: Array) -> tuple[Array, Array, Array]:
    """Values (N, 3) -> minima and maxima of the chunks (C, 3), and the values as fractions of their chunk's range."""
    starts = np.arange(0, len(x), CHUNK)
    low, high = np.minimum.reduceat(x, starts), np.maximum.reduceat(x, starts)
    of = np.arange(len(x)) // CHUNK
    extent = high.astype(np.float64) - low
    return low, high, (x - low[of].astype(np.float64)) / np.where(extent == 0, 1, extent)[of]


def _pack(fractions: Array, bits: tuple[int, ...]) -> Array:
    """Fractions (N, 3) -> uint32, the first component in the highest bits."""
    word = np.zeros(len(fractions), np.uint32)
    for column, width in enumerate(bits):
        word = word << width | np.rint(fractions[:, column] * (2**width - 1)).astype(np.uint32)
    return word


def _unpack(words: Array, bits: tuple[int, ...]) -> Array:
    """Inverse of `_pack`, (N, 3); bits above are ignored."""
    shifts = [sum(bits[column + 1 :]) for column in range(3)]
    fields = [(words >> shift & (2**width - 1)) / (2**width - 1) for shift, width in zip(shifts, bits, strict=True)]
    return np.stack(fields, axis=1)


def _element(table: Array, names: tuple[str, ...], element: str) -> "PlyElement":
    from plyfile import PlyElement

    table = np.ascontiguousarray(table)
    rows = table.view([(name, table.dtype.str) for name in names])[:, 0]
    return PlyElement.describe(rows, element)
