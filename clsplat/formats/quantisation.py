"""What the compact formats share: the check before writing, rounding that tells what it cut off, quaternions by their
three smallest components, an order in which neighbours follow each other, and a bound on what a file unfolds to."""

import math
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.config import Mode
from clsplat.errors import InputError
from clsplat.formats.ply import LOG_SCALE_MIN, LOGIT_MAX, checked_offset, normalised
from clsplat.gaussians import Gaussians, logit

Array = NDArray[Any]

EXPANSION_MAX = 100
EXPANSION_FREE = 1 << 26
"""A file that declares to unfold to more bytes than both this multiple of its size and this many is refused as a
bomb. Trained scenes unfold to 1.2 to 10 times; 64 MiB harm nobody."""

SQRT1_2 = math.sqrt(0.5)
"""Largest magnitude of any but the largest component of a unit quaternion."""

OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Components of a quaternion but the one named by the row."""

MORTON_BITS = 21
"""Per axis: three of them fit into 64 bits."""


def checked(path: str | Path, gaussians: Gaussians) -> Gaussians:
    """Gaussians fit for writing: float32, unit quaternions; those without orientation, which no renderer draws,
    become transparent, since the formats cannot hold a zero quaternion.

    Raises
    ------
    InputError
        If there is none, shapes do not fit, or a value is not finite as float32.
    """
    gaussians.validate()
    if len(gaussians) == 0:
        raise InputError(f"{path}: expected at least one Gaussian to write, found none")
    with np.errstate(over="ignore"):  # what overflows float32 is found below
        out = check_finite(path, gaussians.astype(np.float32))
    out.quats = normalised(out.quats).astype(np.float32)
    nowhere = ~out.quats.any(axis=1)
    out.quats[nowhere, 0] = 1
    out.logit_opacities[nowhere] = -LOGIT_MAX
    return out


def check_finite(path: str | Path, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians, or raise InputError naming the first field with a value that is not finite."""
    n = len(gaussians)
    for name, array in gaussians.arrays().items():
        finite = np.isfinite(array.reshape(n, -1)).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            raise InputError(
                f"{path}: expected finite values, found {name} = {array[row].tolist()} in Gaussian {row} "
                f"({n - int(finite.sum())} of {n} Gaussians are affected)"
            )
    return gaussians


def check_expansion(path: str | Path, needed: int, size: int) -> None:
    """Raise InputError if `size` bytes of a file declare to unfold to `needed` bytes, more than a scene does."""
    if needed > max(EXPANSION_FREE, EXPANSION_MAX * size):
        raise InputError(
            f"{path}: expected a file of a scene, which unfolds to at most {EXPANSION_MAX} times its {size} bytes, "
            f"found that it declares {needed} bytes; it is damaged or made to exhaust memory"
        )


def file_size(path: str | Path) -> int:
    """Bytes of a file; OSError if there is none."""
    return os.stat(path).st_size


def clamped(path: str | Path, name: str, x: Array, low: float, high: float) -> Array:
    """Values within `low` and `high`; warns of the number of Gaussians (rows) that have others."""
    outside = ((x < low) | (x > high)).reshape(len(x), -1).any(axis=1).sum()
    if outside:
        warnings.warn(
            f"{path}: {name} of {outside} of {len(x)} Gaussians lie beyond what the format can hold; clamped",
            stacklevel=3,
        )
    return np.clip(x, low, high)


def rounded(path: str | Path, name: str, x: Array, top: int) -> Array:
    """Nearest whole numbers 0 to `top`, as the smallest unsigned type.

    What lies up to a step outside, as the 1 of a unit quaternion in many formats, is rounded to the end;
    what lies further is `clamped`.
    """
    return np.clip(np.rint(clamped(path, name, x, -1, top + 1)), 0, top).astype(np.min_scalar_type(top))


def warn_lost(path: str | Path, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Warn of what is given but has no place in the format."""
    if mode != "classic":
        warnings.warn(f"{path}: the format cannot say that the scene was trained {mode}", stacklevel=3)
    shift = checked_offset(offset)
    if shift.any():
        warnings.warn(
            f"{path}: the format has no place for the world's offset {shift.tolist()}; "
            "coordinates are written without it",
            stacklevel=3,
        )


def opacity_bytes(gaussians: Gaussians) -> Array:
    """Opacities as bytes: 255 times, rounded."""
    return np.rint(255 * gaussians.opacities).astype(np.uint8)


def logits_of(opacities: Array) -> Array:
    """Logits of opacities stored as bytes, float32; ±LOGIT_MAX for 0 and 255."""
    with np.errstate(divide="ignore"):
        table = np.clip(logit(np.arange(256) / 255), -LOGIT_MAX, LOGIT_MAX)
    return table.astype(np.float32)[opacities]


def logs_of(scales: Array) -> Array:
    """Natural logarithms of scales; LOG_SCALE_MIN for 0, NaN for what is no scale."""
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(scales)
    return np.where(scales == 0, np.float32(LOG_SCALE_MIN), logs)


def smallest_three(quats: Array) -> tuple[Array, Array]:
    """Index of the component of largest magnitude (N,), and the other three (N, 3) in their order.

    The sign is such that the component left out is positive, which is the same rotation; the others are within
    ±SQRT1_2.
    """
    largest = np.argmax(np.abs(quats), axis=1)[:, None]
    sign = np.where(np.take_along_axis(quats, largest, axis=1) < 0, -1, 1)
    return largest[:, 0], np.take_along_axis(quats, OTHERS[largest[:, 0]], axis=1) * sign


def from_smallest_three(largest: Array, others: Array) -> Array:
    """Unit quaternions, (N, 4) float32: inverse of `smallest_three`."""
    quats = np.empty((len(others), 4))
    rest = 1 - np.einsum("ni,ni->n", others, others)
    np.put_along_axis(quats, OTHERS[largest], others, axis=1)
    np.put_along_axis(quats, largest[:, None].astype(np.intp), np.sqrt(np.maximum(rest, 0))[:, None], axis=1)
    return normalised(quats).astype(np.float32)


def morton_order(means: Array) -> Array:
    """Permutation that sorts points (N, 3) along a Z-order curve: near ones follow each other."""
    low = means.min(axis=0).astype(np.float64)
    extent = np.maximum(means.max(axis=0) - low, np.finfo(np.float32).tiny)
    cells = ((means - low) / extent * (2**MORTON_BITS - 1)).astype(np.uint64)
    # Each step halves the runs of neighbouring bits and moves them apart, until two zeros follow every bit.
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
