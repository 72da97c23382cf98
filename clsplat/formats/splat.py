"""The .splat of antimatter15's viewer: 32 bytes for each Gaussian and nothing else.

Three float32 positions, three float32 scales (not their logarithm), RGBA as bytes, quaternion wxyz as bytes
128 q + 128. Largest and most opaque Gaussians come first, so that a viewer can show what has arrived. There are
no spherical harmonics, no rendering mode and no offset.
"""

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.formats.ply import normalised
from clsplat.formats.quantisation import (
    check_finite,
    checked,
    file_size,
    logits_of,
    logs_of,
    opacity_bytes,
    rounded,
    warn_lost,
)
from clsplat.gaussians import Gaussians

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgb", "u1", 3), ("opacity", "u1"), ("quats", "u1", 4)])


def load_splat(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a .splat file.

    Returns
    -------
    gaussians : Gaussians
        float32, SH degree 0.
    mode : {"classic", "antialiased"}
        Always classic: the format does not say.
    offset : (3,) float64
        Zeros.

    Raises
    ------
    InputError
        If the file cannot be read, has no whole number of rows, holds no Gaussian, or values that are not finite.
    """
    try:
        size = file_size(path)
        if size == 0 or size % ROW.itemsize:
            raise InputError(
                f"{path}: expected a .splat file, a multiple of {ROW.itemsize} bytes, found {size}; "
                "it is truncated or of another format"
            )
        rows = np.fromfile(path, ROW)
    except OSError as error:
        raise InputError(f"{path}: expected a readable .splat file, found: {error.strerror or error}") from error
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

    Positions and scales keep float32; colour, opacity and quaternion are rounded to 1/255 and 1/128. Warns
    of what is lost: bands of the spherical harmonics, the mode, the offset, colours beyond 0..1.

    Parameters
    ----------
    path : str or Path
        The file; its folder must exist.
    gaussians : Gaussians
        At least one, finite.
    mode : {"classic", "antialiased"}
        The rendering mode the scene was trained for.
    offset : (3,) array_like, optional
        What was subtracted from the world's coordinates.

    Raises
    ------
    InputError
        If there is no Gaussian, a value or scale is not finite as float32, or the file cannot be written.
    """
    g = checked(path, gaussians)
    warn_lost(path, mode, offset)
    if g.sh_degree:
        warnings.warn(
            f"{path}: the format holds no spherical harmonics; degree {g.sh_degree} is cut to 0", stacklevel=2
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
