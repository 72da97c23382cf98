"""Checks and repairs that every format shares: readable files, finite values, unit quaternions, world offsets."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clsplat.constants import QUAT_NORM2_MIN
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

LOGIT_MAX = 20.0
"""Magnitude of the logit that stands for an opacity of 0 or 1, which 8-bit formats contain and whose logit is
infinite. In float32, sigmoid(20) is 1. Converters may write the infinity (splat-transform does)."""

LOG_SCALE_MIN = -40.0
"""Natural logarithm that stands for a scale of 0. In float32, the square of exp(-40) is not yet 0. Converters may
write the infinity (splat-transform does)."""

UNIT_SLACK = 2.0**-22
"""Deviation of a quaternion's norm from 1 up to which it counts as a unit quaternion and keeps its bits: the
resolution of float32 components."""


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Raise an InputError that names `path` for an OSError in the block."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def read_rows(path: str | Path, file: BinaryIO, dtype: DTypeLike, count: int) -> Array:
    """Read an array (count,) from where an open file is. `numpy.fromfile` takes a failing disk for the file's end.

    Raises
    ------
    OSError
        If the file cannot be read.
    InputError
        If it ends earlier; `path` names it.
    """
    rows = np.empty(count, dtype)
    done = file.readinto(rows.view(np.uint8)) if rows.nbytes else 0  # type: ignore[attr-defined]
    if done != rows.nbytes:
        raise InputError(f"{path}: expected {rows.nbytes} more bytes, found {done}; the file is truncated")
    return rows


def check_storable(path: str | Path, gaussians: Gaussians) -> None:
    """Raise an InputError if there is no Gaussian to write to `path`, or the shapes of the arrays do not agree."""
    gaussians.validate()
    if len(gaussians) == 0:
        raise InputError(f"{path}: expected at least one Gaussian to write, found none")


def check_finite(path: str | Path, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians, or raise an InputError that names the first field with a value that is not finite."""
    arrays = gaussians.arrays()
    if not all(np.isfinite(array).all() for array in arrays.values()):
        raise not_finite(path, arrays)
    return gaussians


def not_finite(path: str | Path, columns: Mapping[str, Array], first: int = 0) -> InputError:
    """Make the error for arrays (N, ...) with a value that is not finite; it names the first such array.

    `first` is the number of their first row in the scene.
    """
    finite: dict[str, Any] = {
        name: np.isfinite(array.reshape(len(array), -1)).all(axis=1) for name, array in columns.items()
    }
    name = next(name for name, rows in finite.items() if not rows.all())
    row = int(np.argmin(finite[name]))
    affected = int((~np.logical_and.reduce(list(finite.values()))).sum())
    return InputError(
        f"{path}: expected finite values, found {name} = {columns[name][row].tolist()} in Gaussian {first + row} "
        f"({affected} of {len(finite[name])} Gaussians are affected)"
    )


def normalised(quats: Array) -> Array:
    """Normalise quaternions (N, 4) to float64.

    The result is zero where the norm is so small that the renderer culls the Gaussian (QUAT_NORM2_MIN), and NaN where
    a component is not finite.
    """
    wide = quats.astype(np.float64)
    norm2 = np.einsum("ni,ni->n", wide, wide)[:, None]
    norm = np.where(norm2 < QUAT_NORM2_MIN, np.inf, np.sqrt(norm2))
    with np.errstate(invalid="ignore"):
        return wide / np.where(np.abs(norm - 1) <= UNIT_SLACK, 1.0, norm)


def checked_offset(offset: ArrayLike | None) -> NDArray[np.float64]:
    """Return a world offset as an array (3,), zeros for None; raise an InputError unless all numbers are finite."""
    shift = np.zeros(3) if offset is None else np.asarray(offset, dtype=np.float64)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise InputError(f"offset: expected three finite numbers, found {offset!r}")
    return shift
