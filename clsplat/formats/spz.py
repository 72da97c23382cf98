"""The .spz of Niantic: planes of 8-bit and 24-bit numbers, compressed.

Versions 3 (gzip) and 4 (Zstandard) are written; version 2 is read as well. These planes hold all Gaussians each:

* positions: 3 signed 24-bit fixed-point numbers;
* opacities: 255 times the opacity;
* colours: 38.25 sh + 127.5;
* log scales: 16 times the log scale, + 160;
* quaternions: 4 bytes with the index of the largest component of xyzw, and sign and 9-bit magnitude of the others; in
  version 2, 3 bytes xyz;
* spherical harmonics above band 0: 128 times the coefficient, + 128; coefficient by coefficient, RGB within each.

The axes of the file are specified as right, up, back; those of a PLY are right, down, forward. Some programs, such as
splat-transform, write the axes of a PLY unchanged and do not say so.
Source: the description next to the implementation, https://github.com/nianticlabs/spz.
"""

import math
import warnings
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import SH_DEGREE_MAX
from clsplat.errors import InputError
from clsplat.formats.axes import RIGHT_UP_BACK, turned
from clsplat.formats.codebook import PALETTE_SHARE, shared_rows
from clsplat.formats.quantisation import (
    SQRT1_2,
    checked,
    from_smallest_three,
    logits_of,
    morton_order,
    opacity_bytes,
    rounded,
    smallest_three,
    warn_lost,
)
from clsplat.formats.spz_container import (
    ANTIALIASED,
    AXES,
    RDF,
    Axes,
    Header,
    Version,
    plane_sizes,
    read_container,
    write_container,
)
from clsplat.formats.validity import normalised
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

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

LEVEL = 0.9
"""Cosine of the angle between a Gaussian's thinnest axis and y from which it counts as part of a level surface."""

SHIFT_MIN = 0.05
"""Smallest distance of the level surfaces from the middle, in standard deviations of the heights, from which the axes
are guessed. Four trained scenes of others have 0.13 to 0.33."""


def load_spz(path: str | Path, axes: Axes | None = None) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from an .spz file of version 2, 3 or 4.

    Parameters
    ----------
    path : str or Path
        The file.
    axes : {"rub", "rdf"}, optional
        Axes of the file: right, up, back or right, down, forward. The default is what the file records and, if it
        records nothing, right, up, back.

    Returns
    -------
    gaussians, mode, offset
        As in `clsplat.formats.load_gaussians`. The Gaussians are in the axes of a PLY: those of a file in right, up,
        back have y and z of the opposite sign. The format does not store the offset.

    Raises
    ------
    InputError
        If the file cannot be read, is of another format or version, is truncated, holds no Gaussian, declares axes
        that clsplat does not know, or declares more than a file of its size can hold.
    """
    header, planes = read_container(path)
    gaussians = decode(path, header, planes)
    signs = AXES[header.axes or 0] if axes is None else AXES[RDF] if axes == "rdf" else RIGHT_UP_BACK
    mode: Mode = "antialiased" if header.flags & ANTIALIASED else "classic"
    return turned(gaussians, signs).astype(np.float32), mode, np.zeros(3)


def save_spz(
    path: str | Path,
    gaussians: Gaussians,
    mode: Mode = "classic",
    offset: ArrayLike | None = None,
    *,
    version: Version = 3,
    axes: Axes = "rub",
) -> None:
    """Write Gaussians as an .spz file.

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
    version : {3, 4}
        3 is compressed by gzip, 4 by Zstandard.
    axes : {"rub", "rdf"}
        Axes of the file: right, up, back, as specified, or right, down, forward, as in a PLY. Version 4 records the
        latter.

    Raises
    ------
    InputError
        If there is no Gaussian, a value is not finite as float32, a position is too large for 24 bits, or the file
        cannot be written.
    """
    g = turned(checked(path, gaussians), AXES[RDF] if axes == "rdf" else RIGHT_UP_BACK)
    warn_lost(path, offset=offset)
    with replacing(path) as out:
        write_spz(path, out, g, mode, version=version, axes=axes)


def write_spz(
    path: str | Path, out: BinaryIO, g: Gaussians, mode: Mode, *, version: Version, axes: Axes = "rub"
) -> None:
    """Write checked Gaussians, in the axes of the file, to an open file; `path` is for errors and warnings."""
    g = g.take(morton_order(g.means))
    shared = shared_rows(g.sh[:, 1:].reshape(len(g), -1), len(g) // PALETTE_SHARE) if g.sh_degree else None
    if shared is not None:  # equal bands next to each other
        g = g.take(np.argsort(shared[1], kind="stable"))
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
    header = Header(version, n, g.sh_degree, bits, flags, RDF if axes == "rdf" else None)
    write_container(out, header, [np.ascontiguousarray(plane).tobytes() for plane in planes])


def fractional_bits(path: str | Path, gaussians: Gaussians) -> int:
    """Choose the number of fractional bits of the positions, 0 to 23.

    The number follows from the size of the Gaussians (SIGMA_STEPS), and is smaller if the scene would not fit into 24
    bits.

    Raises
    ------
    InputError
        If a coordinate does not fit into 24 bits even without fractional bits.

    Warns
    -----
    UserWarning
        If far Gaussians leave fewer bits than the size of the Gaussians calls for.
    """
    finest = float(np.median(gaussians.log_scales.min(axis=1)))
    wanted = math.ceil(math.log2(SIGMA_STEPS) - finest / math.log(2))
    largest = float(np.abs(gaussians.means).max())
    room = 23 - math.frexp(largest * (1 + 2.0**-22))[1]  # a rounded coordinate must stay below 2^23
    if room < 0:
        raise InputError(
            f"{path}: expected coordinates within ±{2**23} units, found {largest:g}; move the scene's origin nearer"
        )
    bits = max(0, min(wanted, room, 23))
    smallest = max(math.exp(finest), math.exp(-LOG_SCALE[1] / LOG_SCALE[0]))  # as the file stores it
    if room < wanted and 2.0**-bits > smallest / SIGMA_STEPS:
        warnings.warn(
            f"{path}: positions have steps of {2.0**-bits:.2g} units, {2.0**-bits / smallest:.2g} times the smallest "
            f"scale of the median Gaussian, since the farthest coordinate is {largest:.3g}; delete far Gaussians in "
            "`clsplat view`, or write .sog or .ply",
            stacklevel=2,
        )
    return bits


def guessed_axes(gaussians: Gaussians) -> Axes | None:
    """Guess the axes of the file of a scene, in the coordinates of that file; None if they cannot be told.

    Level surfaces, which floors, tables and lawns have and ceilings rarely, lie below the rest of a scene. A
    Gaussian counts as level if its thinnest axis is within 26 degrees of y. Weights are the largest cross-section
    times opacity, up to the 99th percentile, since the background has few huge Gaussians.
    """
    scales = np.sort(gaussians.scales.astype(np.float64), axis=1)
    weights = scales[:, 1] * scales[:, 2] * gaussians.opacities
    weights = np.minimum(weights, np.quantile(weights, 0.99))
    w, x, y, z = gaussians.quats.T.astype(np.float64)
    # The second row of the rotation matrix: the y of each principal axis.
    upward = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    thinnest = np.argmin(gaussians.log_scales, axis=1)[:, None]
    level = weights * (np.abs(np.take_along_axis(upward, thinnest, axis=1))[:, 0] > LEVEL)
    low, high = np.quantile(gaussians.means[:, 1], [0.02, 0.98])
    heights = np.clip(gaussians.means[:, 1].astype(np.float64), low, high)
    if not (level.sum() > 0 and heights.std() > 0):
        return None
    shift = np.average(heights, weights=level) - np.average(heights, weights=weights)
    return None if abs(shift) < SHIFT_MIN * heights.std() else "rub" if shift < 0 else "rdf"


def decode(path: str | Path, header: Header, planes: list[bytes]) -> Gaussians:
    """Convert planes to Gaussians in the axes of the file."""
    n, degree = header.n, header.degree
    positions, opacities, colors, scales, quats, rest = (
        np.frombuffer(plane, np.uint8).reshape(n, size // n)
        for plane, size in zip(planes, plane_sizes(n, degree, header.version), strict=True)
    )
    fixed = np.zeros((n, 3, 4), np.uint8)
    fixed[:, :, 1:] = positions.reshape(n, 3, 3)  # fills the upper 24 bits; the division by 256 below keeps the sign
    sh0 = (colors.astype(np.float32) - COLOR[1]) / COLOR[0]
    sh = np.concatenate([sh0, (rest.astype(np.float32) - SH[1]) / SH[0]], axis=1).reshape(n, -1, 3)
    if degree > SH_DEGREE_MAX:
        warnings.warn(f"{path}: spherical harmonics of degree {degree} are cut to {SH_DEGREE_MAX}", stacklevel=2)
        sh = sh[:, : (SH_DEGREE_MAX + 1) ** 2]
    return Gaussians(
        fixed.view("<i4")[:, :, 0] / 256 / 2.0**header.bits,
        (scales.astype(np.float32) - LOG_SCALE[1]) / LOG_SCALE[0],
        _unpack_xyz(quats) if header.version == 2 else _unpack(quats),
        logits_of(opacities[:, 0]),
        sh,
    )


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
