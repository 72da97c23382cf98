"""Quantisation, as the compact formats share it: checks before writing, rounding with a warning for clamped values,
quaternions by their three smallest components, the Z-order of positions, and a limit on the size of unpacked data."""

import math
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.config import Mode
from clsplat.errors import InputError
from clsplat.formats.validity import (
    LOG_SCALE_MIN,
    LOGIT_MAX,
    check_finite,
    check_storable,
    checked_offset,
    normalised,
)
from clsplat.gaussians import Gaussians, logit

Array = NDArray[Any]

EXPANSION_MAX = 100
"""Largest ratio of the declared unpacked size to the size of a file. Larger ones are refused as decompression bombs.
Ratios of trained scenes: docs/formats.md."""

EXPANSION_FREE = 1 << 26
"""Unpacked size, in bytes, up to which any ratio is accepted, since it cannot exhaust the memory."""

SQRT1_2 = math.sqrt(0.5)
"""Largest magnitude of any but the largest component of a unit quaternion."""

OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Indices of the components of a quaternion other than the one whose index is the row."""

MORTON_BITS = 21
"""Bits per axis of a Morton code: three axes fit into 64 bits."""


def checked(path: str | Path, gaussians: Gaussians) -> Gaussians:
    """Check Gaussians and prepare them for writing: float32, unit quaternions.

    The compact formats cannot hold a zero quaternion. Gaussians without orientation, which no renderer draws, become
    transparent instead.

    Raises
    ------
    InputError
        If there is no Gaussian, shapes do not agree, or a value is not finite as float32.
    """
    check_storable(path, gaussians)
    with np.errstate(over="ignore"):  # values that overflow float32 are rejected below
        out = check_finite(path, gaussians.astype(np.float32))
    out.quats = normalised(out.quats).astype(np.float32)
    nowhere = ~out.quats.any(axis=1)
    out.quats[nowhere, 0] = 1
    out.logit_opacities[nowhere] = -LOGIT_MAX
    return out


def check_expansion(path: str | Path, needed: int, size: int) -> None:
    """Raise an InputError if a file of `size` bytes declares to unpack to `needed` bytes, more than a scene does."""
    if needed > max(EXPANSION_FREE, EXPANSION_MAX * size):
        raise InputError(
            f"{path}: expected a scene, which unpacks to at most {EXPANSION_MAX} times the {size} bytes of its file, "
            f"found {needed} declared bytes; the file is damaged or made to exhaust memory"
        )


def file_size(path: str | Path) -> int:
    """Return the size of a file in bytes; raise an OSError if it does not exist."""
    return os.stat(path).st_size


def clamped(path: str | Path, name: str, x: Array, low: float, high: float) -> Array:
    """Clamp values to [`low`, `high`], and warn with the number of Gaussians (rows) affected."""
    outside = ((x < low) | (x > high)).reshape(len(x), -1).any(axis=1).sum()
    if outside:
        warnings.warn(
            f"{path}: {name} of {outside} of {len(x)} Gaussians lie beyond what the format can hold; clamped",
            stacklevel=3,
        )
    return np.clip(x, low, high)


def rounded(path: str | Path, name: str, x: Array, top: int) -> Array:
    """Round to integers 0 to `top`, of the smallest unsigned type.

    Values up to one step outside are rounded to the end of the range, without a warning: the 1 of a unit quaternion
    is such a value in many formats. Values farther outside are `clamped`.
    """
    return np.clip(np.rint(clamped(path, name, x, -1, top + 1)), 0, top).astype(np.min_scalar_type(top))


def warn_lost(path: str | Path, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Warn if the rendering mode or the offset is lost, because the format cannot store it."""
    if mode != "classic":
        warnings.warn(f"{path}: the format cannot store the rendering mode of the scene, {mode}", stacklevel=3)
    shift = checked_offset(offset)
    if shift.any():
        warnings.warn(
            f"{path}: the format has no place for the world offset {shift.tolist()}; coordinates are written "
            "without it",
            stacklevel=3,
        )


def opacity_bytes(gaussians: Gaussians) -> Array:
    """Convert opacities to bytes: 255 times the opacity, rounded."""
    return np.rint(255 * gaussians.opacities).astype(np.uint8)


def logits_of(opacities: Array) -> Array:
    """Convert opacities stored as bytes to logits, float32; 0 and 255 become -LOGIT_MAX and LOGIT_MAX."""
    with np.errstate(divide="ignore"):
        table = np.clip(logit(np.arange(256) / 255), -LOGIT_MAX, LOGIT_MAX)
    return table.astype(np.float32)[opacities]


def logs_of(scales: Array) -> Array:
    """Convert scales to their natural logarithms; 0 becomes LOG_SCALE_MIN, invalid scales become NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(scales)
    return np.where(scales == 0, np.float32(LOG_SCALE_MIN), logs)


def smallest_three(quats: Array) -> tuple[Array, Array]:
    """Encode quaternions: index of the component of largest magnitude (N,), and the other three in order (N, 3).

    The sign is chosen so that the omitted component is positive, which is the same rotation. The others are within
    ±SQRT1_2.
    """
    largest = np.argmax(np.abs(quats), axis=1)[:, None]
    sign = np.where(np.take_along_axis(quats, largest, axis=1) < 0, -1, 1)
    return largest[:, 0], np.take_along_axis(quats, OTHERS[largest[:, 0]], axis=1) * sign


def from_smallest_three(largest: Array, others: Array) -> Array:
    """Decode unit quaternions, (N, 4) float32: the inverse of `smallest_three`."""
    quats = np.empty((len(others), 4))
    rest = 1 - np.einsum("ni,ni->n", others, others)
    np.put_along_axis(quats, OTHERS[largest], others, axis=1)
    np.put_along_axis(quats, largest[:, None].astype(np.intp), np.sqrt(np.maximum(rest, 0))[:, None], axis=1)
    return normalised(quats).astype(np.float32)


def morton_order(means: Array) -> Array:
    """Compute the permutation that sorts points (N, 3) along a Z-order curve, so that neighbours are adjacent."""
    low = means.min(axis=0).astype(np.float64)
    extent = np.maximum(means.max(axis=0) - low, np.finfo(np.float32).tiny)
    cells = ((means - low) / extent * (2**MORTON_BITS - 1)).astype(np.uint64)
    # Each step halves the runs of adjacent bits and moves the halves apart, until two zeros follow every bit.
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    codes = cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2))
    return np.argsort(codes, kind="stable")
