"""The .splat of antimatter15's viewer: 32 bytes per Gaussian and nothing else.

A row holds three float32 positions, three float32 scales (not their logarithms), RGBA as bytes, and the quaternion
wxyz as bytes 128 q + 128. The largest and most opaque Gaussians come first, so that a viewer can show them while it
downloads the rest. The format has no spherical harmonics above band 0, no rendering mode and no offset.
"""

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.formats.quantisation import checked, file_size, logits_of, logs_of, opacity_bytes, rounded, warn_lost
from clsplat.formats.validity import check_finite, normalised, read_rows, reading
from clsplat.gaussians import Gaussians

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgb", "u1", 3), ("opacity", "u1"), ("quats", "u1", 4)])
"""Layout of a Gaussian."""


def load_splat(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a .splat file.

    Returns
    -------
    gaussians, mode, offset
        As in `clsplat.formats.load_gaussians`: SH degree 0; the format stores neither mode nor offset.

    Raises
    ------
    InputError
        If the file cannot be read, its size is not a multiple of a row, or it holds no Gaussian or values that are
        not finite.
    """
    with reading(path), open(path, "rb") as file:
        size = file_size(path)
        if size == 0 or size % ROW.itemsize:
            raise InputError(
                f"{path}: expected a .splat file, a multiple of {ROW.itemsize} bytes, found {size}; "
                "it is truncated or of another format"
            )
        rows = read_rows(path, file, ROW, size // ROW.itemsize)
    sh0 = (rows["rgb"] / np.float32(255) - np.float32(0.5)) / np.float32(SH_C0)
    gaussians = Gaussians(
        rows["means"],
        logs_of(rows["scales"]),
        normalised((rows["quats"].astype(np.float32) - 128) / 128),
        logits_of(rows["opacity"]),
        sh0[:, None],
    )
    return check_finite(path, gaussians.astype(np.float32)), "classic", np.zeros(3)


def save_splat(
    path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None
) -> None:
    """Write Gaussians as a .splat file, sorted by volume times opacity, largest first.

    Positions and scales stay float32. Colours and opacities are rounded to multiples of 1/255, quaternions to
    multiples of 1/128. Warnings name what is lost: bands of the spherical harmonics above 0, the mode, the offset,
    colours beyond 0 to 1.

    Parameters
    ----------
    path, gaussians, mode, offset
        As in `clsplat.formats.save_gaussians`.

    Raises
    ------
    InputError
        If there is no Gaussian, a value or scale is not finite as float32, or the file cannot be written.
    """
    g = checked(path, gaussians)
    warn_lost(path, mode, offset)
    if g.sh_degree:
        warnings.warn(
            f"{path}: the format cannot store spherical harmonics; degree {g.sh_degree} is cut to 0", stacklevel=2
        )
    order = np.argsort(-(g.log_scales.sum(axis=1) + np.log(np.maximum(g.opacities, 1e-9))), kind="stable")
    g = g.take(order)
    rows = np.empty(len(g), ROW)
    rows["means"] = g.means
    with np.errstate(over="ignore"):
        rows["scales"] = g.scales
    if not np.isfinite(rows["scales"]).all():
        raise InputError(f"{path}: expected scales that float32 can hold, found log_scales = {g.log_scales.max()}")
    rows["rgb"] = rounded(path, "colours", 255 * (0.5 + SH_C0 * g.sh[:, 0]), 255)
    rows["opacity"] = opacity_bytes(g)
    rows["quats"] = rounded(path, "quats", 128 * g.quats + 128, 255)
    with replacing(path) as out:
        out.write(rows.tobytes())
