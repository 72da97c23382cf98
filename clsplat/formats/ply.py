"""The PLY of the original implementation, which the whole ecosystem reads.

One element ``vertex`` of N Gaussians, float32, pre-activation: ``x y z``, ``nx ny nz`` (zeros), ``f_dc_0..2``,
``f_rest_0..(3(K-1)-1)`` channel by channel (all of red, then green, then blue), ``opacity`` (logit),
``scale_0..2`` (natural logarithm), ``rot_0..3`` (wxyz). The comment ``SplatRenderMode: mip`` marks scenes trained in
the antialiased mode (Brush's convention); ``offset x y z`` is what was subtracted from a geo-referenced world.
"""

import io
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import QUAT_NORM2_MIN, SH_DEGREE_MAX
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians

if TYPE_CHECKING:
    from plyfile import PlyElement

Array = NDArray[Any]

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
LOG_SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
REQUIRED = (*MEANS, *SH0, "opacity", *LOG_SCALES, *QUATS)
REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(SH_DEGREE_MAX + 1))

MIP_COMMENT = "SplatRenderMode: mip"

HEADER_MAX = 1 << 20
"""Bytes searched for the end of the header; that of a degree-3 scene has 1.5 kB."""

LOGIT_MAX = 20.0
LOG_SCALE_MIN = -40.0
"""Take the place of infinities with a meaning, which converters write (splat-transform keeps them, too): an opacity
of 0 or 1 from 8-bit formats, a scale of 0. In float32 sigmoid(20) is 1, and the square of exp(-40) is not yet 0."""

UNIT_SLACK = 2.0**-22
"""Quaternions whose norm is as near to 1 as float32 components can tell stay as they are, bit for bit."""


def load_ply(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a PLY file: ASCII or binary of either byte order, properties by name in any order.

    Parameters
    ----------
    path : str or Path
        The file. Normals and ``f_rest_*`` may be missing, other properties are ignored.

    Returns
    -------
    gaussians : Gaussians
        float32, in the file's coordinates; quaternions normalised (zero where they have no direction, such
        Gaussians are not drawn), infinite logits of opacity replaced by ±20, logarithms of zero scales by -40.
    mode : {"classic", "antialiased"}
        What the file's comments say about the rendering mode.
    offset : (3,) float64
        What was subtracted from the world's coordinates, in world units; zeros if the file does not say.

    Raises
    ------
    InputError
        If the file cannot be read, is no PLY, is truncated, holds something else than Gaussians, lacks
        properties, or holds no Gaussian or values that are not finite.
    """
    try:
        with open(path, "rb") as file:
            return _load(path, file)
    except OSError as error:
        raise InputError(f"{path}: expected a readable PLY file, found: {error.strerror or error}") from error


def save_ply(path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Write Gaussians as the original does: binary little endian, float32, properties in its order.

    Parameters
    ----------
    path : str or Path
        The file; its folder must exist.
    gaussians : Gaussians
        At least one, finite. Quaternions are written normalised (zero where they have no direction).
    mode : {"classic", "antialiased"}
        The rendering mode the scene was trained for.
    offset : (3,) array_like, optional
        What was subtracted from the world's coordinates, in world units. It becomes a comment: the coordinates
        stay local, since float32 holds no geo-referenced ones.

    Raises
    ------
    InputError
        If there is no Gaussian, a value is not finite as float32, or the file cannot be written.
    """
    from plyfile import PlyData, PlyElement

    gaussians.validate()
    comments = comments_of(mode, offset)
    n, k = gaussians.sh.shape[:2]
    if n == 0:
        raise InputError(f"{path}: expected at least one Gaussian to write, found none")
    rest = tuple(f"f_rest_{i}" for i in range(3 * (k - 1)))
    names = (*MEANS, *NORMALS, *SH0, *rest, "opacity", *LOG_SCALES, *QUATS)
    table = np.zeros((n, len(names)), dtype="<f4")
    columns = {
        MEANS: gaussians.means,
        SH0: gaussians.sh[:, 0],
        rest: gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(n, -1),
        ("opacity",): gaussians.logit_opacities[:, None],
        LOG_SCALES: gaussians.log_scales,
        QUATS: normalised(gaussians.quats),
    }
    with np.errstate(over="ignore"):  # what overflows float32 is found below
        for group, values in columns.items():
            if group:
                first = names.index(group[0])
                table[:, first : first + len(group)] = values
    _check_finite(path, table, names)

    vertices = table.view([(name, "<f4") for name in names])[:, 0]
    ply = PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=comments)
    with replacing(path) as out:
        ply.write(out)


def _load(path: str | Path, file: BinaryIO) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    header, size = read_header(path, file)
    elements, counts, order, comments = parse_header(path, header)
    _check_elements(path, elements, counts)
    vertex = elements["vertex"]
    names = [prop.name for prop in vertex.properties]
    rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    rest_names = [f"f_rest_{i}" for i in range(rest)]
    missing = [name for name in (*REQUIRED, *rest_names) if name not in names]
    if missing:
        raise InputError(
            f"{path}: expected the properties of a Gaussian scene, "
            f"missing {', '.join(missing)} among {', '.join(names)}"
        )
    if rest not in REST_COUNTS:
        raise InputError(
            f"{path}: expected {', '.join(map(str, REST_COUNTS))} properties f_rest_* (SH degree 0 to 3), "
            f"found {rest}"
        )
    wanted = [*REQUIRED, *rest_names]
    data = _read_vertices(path, file, (elements, counts, order), (len(header), size))
    return _to_gaussians(path, data, wanted), *read_comments(comments)


def read_points(path: str | Path, file: BinaryIO) -> Array:
    """The vertices of any PLY file, a structured array (N,) of the types its header declares, with x, y and z."""
    header, size = read_header(path, file)
    elements, counts, order, _ = parse_header(path, header)
    names = [prop.name for prop in elements["vertex"].properties] if "vertex" in elements else []
    if missing := set(MEANS) - set(names):
        raise InputError(f"{path}: expected points with x, y and z, found no {', '.join(sorted(missing))}")
    data = _read_vertices(path, file, (elements, counts, order), (len(header), size))
    if order != "=":
        return data
    with np.errstate(over="ignore", invalid="ignore"):
        typed = data.astype(elements["vertex"].dtype())
    for name in names:
        if typed[name].dtype.kind in "iu" and (typed[name] != data[name]).any():
            raise InputError(f"{path}: expected {name} within {typed[name].dtype} as the header says, found others")
    return typed


def read_header(path: str | Path, file: BinaryIO) -> tuple[bytes, int]:
    """The header with its last line's end, and the size of the file."""
    head = file.read(HEADER_MAX)
    size = file.seek(0, io.SEEK_END)
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", head)
    if first is None:
        raise InputError(f"{path}: expected a PLY file, whose first line is 'ply', found {head[:12]!r}")
    end = re.search(re.escape(first[1]) + rb"end_header[ \t]*" + re.escape(first[1]), head)
    if end is None:
        raise InputError(f"{path}: expected a PLY header that ends with 'end_header', found none; is it truncated?")
    return head[: end.end()], size


def parse_header(path: str | Path, header: bytes) -> tuple[dict[str, "PlyElement"], list[int], str, list[str]]:
    """Elements with their properties, rows of each, byte order ('<', '>', or '=' for ASCII), comments.

    plyfile parses the header with all counts set to 0: it would allocate what the file declares, and would
    refuse comments that are not ASCII.
    """
    from plyfile import PlyData, PlyParseError

    lines, counts, comments = [], [], []
    try:
        for line in header.splitlines():  # of bytes: a str would also be split within comments in UTF-8
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
    except (PlyParseError, ValueError) as error:
        raise InputError(f"{path}: expected a well-formed PLY header, found: {error}") from error
    return {e.name: e for e in ply.elements}, counts, "=" if ply.text else ply.byte_order, comments


def _check_elements(path: str | Path, elements: dict[str, "PlyElement"], counts: list[int]) -> None:
    """Tell Gaussians from the other things that are stored as PLY."""
    if "vertex" not in elements:
        raise InputError(f"{path}: expected an element 'vertex', found {', '.join(elements) or 'no element'}")
    names = {prop.name for prop in elements["vertex"].properties}
    count = counts[list(elements).index("vertex")]
    if "packed_position" in names:
        raise InputError(
            f"{path}: is a compressed PLY of PlayCanvas, which is told by its name; rename it to *.compressed.ply"
        )
    if names.isdisjoint((*SH0, "opacity", *LOG_SCALES, *QUATS)):
        kind = "a mesh" if "face" in elements else "a point cloud"
        raise InputError(
            f"{path}: is {kind} of {count} points, not a scene of Gaussians (no opacity, scale_*, rot_*); "
            "train a scene from photos instead"
        )
    if count == 0:
        raise InputError(f"{path}: expected at least one Gaussian, found none")


def _check_size(
    path: str | Path, elements: list["PlyElement"], counts: list[int], order: str, sizes: tuple[int, int]
) -> None:
    """Compare what the header declares, up to the last Gaussian, with the bytes that are there."""
    from plyfile import PlyListProperty

    header, size = sizes
    needed = header
    for element, count in zip(elements, counts, strict=True):
        if order == "=":
            needed += count * 2 * len(element.properties)  # a digit and a separator for each value
        elif any(isinstance(prop, PlyListProperty) for prop in element.properties):
            raise InputError(f"{path}: expected no list property up to the Gaussians, found one in '{element.name}'")
        else:
            needed += count * element.dtype().itemsize
        if element.name == "vertex":
            break
    if order == "=":
        needed -= 1  # the last line may lack its end
    if size < needed:
        raise InputError(
            f"{path}: expected at least {needed} bytes for the {count} Gaussians its header declares, found {size}; "
            "the file is truncated or damaged"
        )


def _read_vertices(
    path: str | Path, file: BinaryIO, parsed: tuple[dict[str, "PlyElement"], list[int], str], sizes: tuple[int, int]
) -> Array:
    """The rows of the element vertex, (N,), of float64 in an ASCII file; `sizes`: of the header and of the file."""
    elements, counts, order = parsed
    _check_size(path, list(elements.values()), counts, order, sizes)
    file.seek(sizes[0])
    before, vertex = list(elements).index("vertex"), elements["vertex"]
    if order == "=":
        names = [prop.name for prop in vertex.properties]
        return _read_text(path, file, sum(counts[:before]), counts[before], names)
    skipped = sum(n * e.dtype().itemsize for n, e in zip(counts[:before], elements.values(), strict=False))
    data: Array = np.fromfile(file, vertex.dtype(order), counts[before], offset=skipped)
    return data


def _read_text(path: str | Path, file: BinaryIO, skip: int, count: int, names: list[str]) -> Array:
    """The rows of an ASCII file as a structured array of float64, (count,)."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of empty lines, which the shape below tells
            rows = np.loadtxt(
                io.TextIOWrapper(file, "latin-1"), comments=None, skiprows=skip, max_rows=count, ndmin=2
            )
    except ValueError as error:
        raise InputError(f"{path}: expected rows of {len(names)} numbers, found: {error}") from error
    if rows.shape != (count, len(names)):
        raise InputError(f"{path}: expected {count} rows of {len(names)} numbers, found {rows.shape}")
    return rows.view([(name, np.float64) for name in names])[:, 0]


def _to_gaussians(path: str | Path, data: Array, names: list[str]) -> Gaussians:
    """Structured array (N,) -> Gaussians, float32; `names` is REQUIRED and the f_rest_*."""
    from numpy.lib.recfunctions import structured_to_unstructured

    with np.errstate(over="ignore"):  # what overflows float32 is found below
        table = structured_to_unstructured(data[names], dtype=np.float32)
    means, sh0, opacity, log_scales, quats, rest = np.split(table, np.cumsum([3, 3, 1, 3, 4]), axis=1)
    np.copyto(opacity, np.copysign(np.float32(LOGIT_MAX), opacity), where=np.isinf(opacity))
    log_scales[np.isneginf(log_scales)] = LOG_SCALE_MIN
    _check_finite(path, table, tuple(names))
    n = len(table)
    sh = np.concatenate([sh0[:, None], rest.reshape(n, 3, -1).transpose(0, 2, 1)], axis=1)
    gaussians = Gaussians(means, log_scales, normalised(quats), opacity[:, 0], sh)
    return gaussians.astype(np.float32)


def normalised(quats: Array) -> Array:
    """Unit quaternions, (N, 4): zeros where the renderer finds no direction and culls, NaN where not finite."""
    wide = quats.astype(np.float64)
    norm2 = np.einsum("ni,ni->n", wide, wide)[:, None]
    norm = np.where(norm2 < QUAT_NORM2_MIN, np.inf, np.sqrt(norm2))
    with np.errstate(invalid="ignore"):
        return wide / np.where(np.abs(norm - 1) <= UNIT_SLACK, 1.0, norm)


def _check_finite(path: str | Path, table: Array, names: tuple[str, ...]) -> None:
    """Raise InputError naming the first column with a value that is not finite."""
    finite = np.isfinite(table)
    if not finite.all():
        column = int(np.argmin(finite.all(axis=0)))
        row = int(np.argmin(finite[:, column]))
        bad = int((~finite.all(axis=1)).sum())
        raise InputError(
            f"{path}: expected finite values, found {names[column]} = {table[row, column]} in Gaussian {row} "
            f"({bad} of {len(table)} Gaussians are affected)"
        )


def checked_offset(offset: ArrayLike | None) -> NDArray[np.float64]:
    """A world offset (3,) as an array, zeros for none; InputError if it is not three finite numbers."""
    shift = np.zeros(3) if offset is None else np.asarray(offset, dtype=np.float64)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise InputError(f"offset: expected three finite numbers, found {offset!r}")
    return shift


def comments_of(mode: Mode, offset: ArrayLike | None) -> list[str]:
    """Comments of a header that say the rendering mode and the world offset, unless they are the default."""
    comments = [MIP_COMMENT] if mode == "antialiased" else []
    shift = checked_offset(offset)
    if shift.any():
        comments.append("offset " + " ".join(repr(float(x)) for x in shift))
    return comments


def read_comments(comments: list[str]) -> tuple[Mode, NDArray[np.float64]]:
    """Rendering mode and world offset; whatever else the comments say is ignored."""
    offset: NDArray[np.float64] = np.zeros(3)
    for comment in comments:
        words = comment.split()
        if words[:1] == ["offset"] and len(words) == 4:
            try:
                values = np.array([float(word) for word in words[1:]])
            except ValueError:
                continue
            offset = values if np.isfinite(values).all() else offset
    return "antialiased" if MIP_COMMENT in comments else "classic", offset
