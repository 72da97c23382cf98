"""The PLY of the original implementation, which almost all other programs read.

One element ``vertex`` with a row per Gaussian, float32, pre-activation: ``x y z``, ``nx ny nz`` (zeros),
``f_dc_0..2``, ``f_rest_0..(3(K-1)-1)`` channel by channel (all of red, then green, then blue), ``opacity`` (logit),
``scale_0..2`` (natural logarithm), ``rot_0..3`` (wxyz). The comment ``SplatRenderMode: mip`` marks scenes trained in
the antialiased mode (Brush's convention). The comment ``offset x y z`` is what was subtracted from a geo-referenced
world.
"""

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import SH_DEGREE_MAX
from clsplat.errors import InputError
from clsplat.formats.ply_container import POSITION, PlyHeader, read_header, read_vertices
from clsplat.formats.validity import (
    LOG_SCALE_MIN,
    LOGIT_MAX,
    check_storable,
    checked_offset,
    normalised,
    not_finite,
    reading,
)
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

MEANS = POSITION
NORMALS = ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
LOG_SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
REQUIRED = (*MEANS, *SH0, "opacity", *LOG_SCALES, *QUATS)
"""Properties that every file of Gaussians has."""

REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(SH_DEGREE_MAX + 1))
"""Numbers of properties ``f_rest_*``, by SH degree."""

MIP_COMMENT = "SplatRenderMode: mip"
"""Comment of scenes trained in the antialiased mode."""


def load_ply(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a PLY file: ASCII or binary of either byte order, properties by name in any order.

    Parameters
    ----------
    path : str or Path
        The file. Normals and ``f_rest_*`` may be missing; other properties are ignored.

    Returns
    -------
    gaussians : Gaussians
        float32, in the coordinates of the file. Quaternions are normalised; those without a direction become zero,
        and such Gaussians are not drawn. Infinite logits of opacity become ±20, logarithms of zero scales -40.
    mode : {"classic", "antialiased"}
        Rendering mode according to the comments of the file.
    offset : (3,) float64
        What was subtracted from the world's coordinates, in world units; zeros if the file has no such comment.

    Raises
    ------
    InputError
        If the file cannot be read, is not a PLY, is truncated, holds something other than Gaussians, lacks
        properties, or holds no Gaussian or values that are not finite.
    """
    with reading(path), open(path, "rb") as file:
        header = read_header(path, file)
        wanted = properties(path, header)
        return to_gaussians(path, read_vertices(path, file, header), wanted), *read_comments(header.comments)


def save_ply(path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Write Gaussians as the original implementation does: binary little endian, float32, properties in its order.

    Parameters
    ----------
    path, gaussians, mode, offset
        As in `clsplat.formats.save_gaussians`. Quaternions are written normalised; those without a direction as zero.
        The offset becomes a comment and the coordinates stay local, since float32 cannot hold geo-referenced ones.

    Raises
    ------
    InputError
        If there is no Gaussian, a value is not finite as float32, or the file cannot be written.
    """
    check_storable(path, gaussians)
    save_ply_parts(path, [gaussians], len(gaussians), gaussians.sh.shape[1], mode, offset)


def save_ply_parts(
    path: str | Path,
    parts: Iterable[Gaussians],
    count: int,
    coefficients: int,
    mode: Mode = "classic",
    offset: ArrayLike | None = None,
) -> None:
    """Write Gaussians that come in parts, of which one at a time is in memory, as `save_ply` writes them together.

    Parameters
    ----------
    path, mode, offset
        As in `save_ply`.
    parts : iterable of Gaussians
        Parts without Gaussians are left out.
    count : int
        Number of all Gaussians, which the header has.
    coefficients : int
        Number K of the spherical harmonics' coefficients in the file. Parts with fewer are filled up with zeros.

    Raises
    ------
    InputError
        If a value is not finite as float32, the file cannot be written, or there are more or fewer Gaussians than
        `count`.
    """
    names, written = names_of(coefficients), 0
    properties = "".join(f"property float {name}\n" for name in names)
    comments = "".join(f"comment {comment}\n" for comment in comments_of(mode, offset))
    header = f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {count}\n{properties}end_header\n"
    with replacing(path) as out:
        out.write(header.encode())
        for part in parts:
            if len(part):
                out.write(table_of(path, with_coefficients(part, coefficients))[1].data)
            written += len(part)
        if written != count:
            raise InputError(f"{path}: expected {count} Gaussians to write, found {written}")


def with_coefficients(gaussians: Gaussians, count: int) -> Gaussians:
    """The Gaussians with at least `count` coefficients of the spherical harmonics; those that they lack are zero."""
    missing = count - gaussians.sh.shape[1]
    return gaussians if missing <= 0 else replace(gaussians, sh=np.pad(gaussians.sh, ((0, 0), (0, missing), (0, 0))))


def names_of(coefficients: int) -> tuple[str, ...]:
    """Names of the properties, in their order, of Gaussians with a number K of coefficients."""
    rest = tuple(f"f_rest_{i}" for i in range(3 * (coefficients - 1)))
    return (*MEANS, *NORMALS, *SH0, *rest, "opacity", *LOG_SCALES, *QUATS)


def table_of(path: str | Path, gaussians: Gaussians) -> tuple[tuple[str, ...], Array]:
    """Make the rows of a PLY: the names of its properties, and a table (N, properties) of float32.

    Raises
    ------
    InputError
        If there is no Gaussian, or a value is not finite as float32.
    """
    check_storable(path, gaussians)
    n, k = gaussians.sh.shape[:2]
    names = names_of(k)
    rest = names[len((*MEANS, *NORMALS, *SH0)) : names.index("opacity")]
    table = np.zeros((n, len(names)), dtype="<f4")
    columns = {
        MEANS: gaussians.means,
        SH0: gaussians.sh[:, 0],
        rest: gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(n, -1),
        ("opacity",): gaussians.logit_opacities[:, None],
        LOG_SCALES: gaussians.log_scales,
        QUATS: normalised(gaussians.quats),
    }
    with np.errstate(over="ignore"):  # values that overflow float32 are rejected below
        for group, values in columns.items():
            if group:
                first = names.index(group[0])
                table[:, first : first + len(group)] = values
    if not np.isfinite(table).all():
        raise not_finite(path, dict(zip(names, table.T, strict=True)))
    return names, table


def properties(path: str | Path, header: PlyHeader) -> list[str]:
    """Return the properties to read, REQUIRED and the ``f_rest_*``.

    Raises
    ------
    InputError
        If the file holds no Gaussians, or something else that is stored as PLY.
    """
    if "vertex" not in header.elements:
        raise InputError(f"{path}: expected an element 'vertex', found {', '.join(header.elements) or 'no element'}")
    names = [prop.name for prop in header.elements["vertex"].properties]
    count = header.rows["vertex"]
    if "packed_position" in names:
        raise InputError(
            f"{path}: expected a PLY of the original layout, found a compressed PLY of PlayCanvas; rename it to "
            "*.compressed.ply"
        )
    if set(names).isdisjoint((*SH0, "opacity", *LOG_SCALES, *QUATS)):
        kind = "a mesh" if "face" in header.elements else "a point cloud"
        raise InputError(
            f"{path}: expected a scene of Gaussians, found {kind} of {count} points without opacity, scale_* and "
            "rot_*; train a scene from photos instead"
        )
    if count == 0:
        raise InputError(f"{path}: expected at least one Gaussian, found none")
    rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    wanted = [*REQUIRED, *(f"f_rest_{i}" for i in range(rest))]
    missing = [name for name in wanted if name not in names]
    if missing:
        raise InputError(
            f"{path}: expected the properties of a scene of Gaussians, missing {', '.join(missing)} among "
            f"{', '.join(names)}"
        )
    if rest not in REST_COUNTS:
        raise InputError(
            f"{path}: expected {', '.join(map(str, REST_COUNTS))} properties f_rest_* (SH degree 0 to 3), "
            f"found {rest}"
        )
    return wanted


def to_gaussians(path: str | Path, data: Array, names: list[str], first: int = 0) -> Gaussians:
    """Convert rows of a PLY to Gaussians, float32.

    Parameters
    ----------
    path : str or Path
        The file, for errors.
    data : (N,) structured array
    names : list of str
        As `properties` returns them.
    first : int
        Number of the first row in the file.

    Raises
    ------
    InputError
        If a value is not finite.
    """
    table = _table(data, names)
    means, sh0, opacity, log_scales, quats, rest = np.split(table, np.cumsum([3, 3, 1, 3, 4]), axis=1)
    np.copyto(opacity, np.copysign(np.float32(LOGIT_MAX), opacity), where=np.isinf(opacity))
    log_scales[np.isneginf(log_scales)] = LOG_SCALE_MIN
    if not np.isfinite(table).all():
        raise not_finite(path, dict(zip(names, table.T, strict=True)), first)
    n = len(table)
    sh = np.concatenate([sh0[:, None], rest.reshape(n, 3, -1).transpose(0, 2, 1)], axis=1)
    gaussians = Gaussians(means, log_scales, normalised(quats), opacity[:, 0], sh)
    return gaussians.astype(np.float32)


def _table(data: Array, names: list[str]) -> Array:
    """Fields of a structured array (N,) as columns of float32; a copy, which may be changed."""
    from numpy.lib.recfunctions import structured_to_unstructured

    stored = data.dtype.names or ()
    if data.dtype == np.dtype([(name, np.float32) for name in stored]):  # what most programs write
        columns = [stored.index(name) for name in names]
        return np.take(data.view(np.float32).reshape(len(data), -1), columns, axis=1)
    with np.errstate(over="ignore"):  # values that overflow float32 are rejected later
        return structured_to_unstructured(data[names], dtype=np.float32, copy=True)


def comments_of(mode: Mode, offset: ArrayLike | None) -> list[str]:
    """Make the comments of a header for a rendering mode and a world offset that are not the default."""
    comments = [MIP_COMMENT] if mode == "antialiased" else []
    shift = checked_offset(offset)
    if shift.any():
        comments.append("offset " + " ".join(repr(float(x)) for x in shift))
    return comments


def read_comments(comments: list[str]) -> tuple[Mode, NDArray[np.float64]]:
    """Find the rendering mode and the world offset in the comments of a header; other comments are ignored."""
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
