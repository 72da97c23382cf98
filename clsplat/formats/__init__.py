"""Readers and writers of files of Gaussians: one module each, enrolled by one line in `FORMATS`.

Belongs here: one module per format and what formats share. Does not belong here: photos, cameras and datasets
(`clsplat.dataset`), and pruning a scene until it fits (`clsplat.pruning`).
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.config import Mode
from clsplat.errors import InputError
from clsplat.formats.compressed_ply import load_compressed_ply, save_compressed_ply
from clsplat.formats.ply import load_ply, save_ply
from clsplat.formats.sog import META, load_sog, save_sog
from clsplat.formats.splat import load_splat, save_splat
from clsplat.formats.spz import load_spz, save_spz
from clsplat.gaussians import Gaussians

__all__ = ["FORMATS", "load_gaussians", "save_gaussians"]

Loader = Callable[[str | Path], tuple[Gaussians, Mode, NDArray[np.float64]]]
Saver = Callable[[str | Path, Gaussians, Mode, ArrayLike | None], None]

# Suffix of the file name -> (load, save); of several that fit, the longest counts.
FORMATS: dict[str, tuple[Loader, Saver]] = {
    ".ply": (load_ply, save_ply),
    ".compressed.ply": (load_compressed_ply, save_compressed_ply),
    ".splat": (load_splat, save_splat),
    ".spz": (load_spz, save_spz),
    ".sog": (load_sog, save_sog),
}


def load_gaussians(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a file in a format of `FORMATS`, told by its suffix, or from a folder with an unpacked SOG.

    Returns
    -------
    gaussians : Gaussians
        float32, at least one.
    mode : {"classic", "antialiased"}
        The rendering mode the file says it was trained for; classic where the format does not say.
    offset : (3,) float64
        What was subtracted from the world's coordinates, in world units; zeros where the format does not say.

    Raises
    ------
    InputError
        If no format has this suffix, or the file is not of its format.
    """
    unpacked = Path(path).is_dir() or Path(path).name == META
    return load_sog(path) if unpacked else _format(path)[0](path)


def save_gaussians(
    path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None
) -> None:
    """Write Gaussians to a file in the format of `FORMATS` that its suffix names.

    Parameters
    ----------
    path : str or Path
        The file; its folder must exist. It is replaced only once all is written.
    gaussians : Gaussians
        At least one, finite.
    mode : {"classic", "antialiased"}
        The rendering mode they were trained for.
    offset : (3,) array_like, optional
        What was subtracted from the world's coordinates, in world units.

    Raises
    ------
    InputError
        If no format has this suffix, the Gaussians cannot be stored, or the file cannot be written.
    """
    _format(path)[1](path, gaussians, mode, offset)


def suffix_of(path: str | Path) -> str:
    """The suffix in `FORMATS` that a file's name ends with, and has something before; empty if none."""
    name = Path(path).name.lower()
    return max((suffix for suffix in FORMATS if name[1:].endswith(suffix)), key=len, default="")


def _format(path: str | Path) -> tuple[Loader, Saver]:
    suffix = suffix_of(path)
    if not suffix:
        raise InputError(
            f"{path}: expected a file of Gaussians named *{', *'.join(FORMATS)}, found suffix {Path(path).suffix!r}"
        )
    return FORMATS[suffix]
