"""Files of Gaussians: a reader, a writer and an anatomy for each format in `FORMATS`.

Belongs here: one module per format, and what formats share: `validity` (all of them), `quantisation` and `codebook`
(the compact ones), `ply_container` (the two in PLY), `anatomy` (bytes by part). Does not belong here: photos, cameras
and datasets (`clsplat.dataset`), and pruning a scene until it fits (`clsplat.pruning`).
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.config import Mode
from clsplat.errors import InputError
from clsplat.formats.anatomy import (
    Anatomy,
    compressed_ply_anatomy,
    ply_anatomy,
    sog_anatomy,
    splat_anatomy,
    spz_anatomy,
)
from clsplat.formats.compressed_ply import load_compressed_ply, save_compressed_ply
from clsplat.formats.ply import load_ply, save_ply
from clsplat.formats.sog import META, load_sog, save_sog
from clsplat.formats.splat import load_splat, save_splat
from clsplat.formats.spz import load_spz, save_spz
from clsplat.gaussians import Gaussians

__all__ = ["FORMATS", "Format", "load_gaussians", "save_gaussians"]

Loader = Callable[[str | Path], tuple[Gaussians, Mode, NDArray[np.float64]]]
Saver = Callable[[str | Path, Gaussians, Mode, ArrayLike | None], None]


class Format(NamedTuple):
    """The functions of a format: reader, writer, and what ``clsplat info`` shows of a file."""

    load: Loader
    save: Saver
    anatomy: Callable[[Path], Anatomy]


FORMATS: dict[str, Format] = {
    ".ply": Format(load_ply, save_ply, ply_anatomy),
    ".compressed.ply": Format(load_compressed_ply, save_compressed_ply, compressed_ply_anatomy),
    ".splat": Format(load_splat, save_splat, splat_anatomy),
    ".spz": Format(load_spz, save_spz, spz_anatomy),
    ".sog": Format(load_sog, save_sog, sog_anatomy),
}
"""Formats by the suffix of the file name. If several suffixes fit, the longest is used."""


SCENES = ("*", "point_cloud/iteration_*/point_cloud.ply", "scene.*")
"""Patterns of scenes in folders of runs, the last one that fits is meant: any file, that of the original code, and
that of ``clsplat train``."""


def load_gaussians(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a file in a format of `FORMATS`, chosen by its suffix, or from a folder with an unpacked
    SOG.

    Parameters
    ----------
    path : str or Path
        The file; for an unpacked SOG, its folder or the meta.json in it.

    Returns
    -------
    gaussians : Gaussians
        float32, at least one.
    mode : {"classic", "antialiased"}
        Rendering mode for which the scene was trained, according to the file; classic if the format does not store
        it.
    offset : (3,) float64
        What was subtracted from the world's coordinates, in world units; zeros if the format does not store it.

    Raises
    ------
    InputError
        If no format has this suffix, or the file is not a valid file of its format; the message names it.
    """
    if Path(path).is_dir() and not (Path(path) / META).exists():
        inside = [file for pattern in SCENES for file in sorted(Path(path).glob(pattern)) if suffix_of(file)]
        hint = f"; the scene in it is {inside[-1]}" if inside else ""
        raise InputError(f"{path}: expected a file of Gaussians, such as scene.ply, found a folder{hint}")
    unpacked = Path(path).is_dir() or Path(path).name == META
    return load_sog(path) if unpacked else _format(path).load(path)


def save_gaussians(
    path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None
) -> None:
    """Write Gaussians to a file in the format of `FORMATS` given by its suffix.

    Parameters
    ----------
    path : str or Path
        The file; its folder must exist. An existing file is replaced only after everything is written.
    gaussians : Gaussians
        At least one, finite.
    mode : {"classic", "antialiased"}
        Rendering mode for which the scene was trained.
    offset : (3,) array_like, optional
        What was subtracted from the world's coordinates, in world units.

    Raises
    ------
    InputError
        If no format has this suffix, the Gaussians cannot be stored, or the file cannot be written.

    Warns
    -----
    UserWarning
        If the format cannot hold the mode, the offset, bands of the spherical harmonics or some values.
    """
    _format(path).save(path, gaussians, mode, offset)


def suffix_of(path: str | Path) -> str:
    """Return the suffix in `FORMATS` at the end of a file's name; empty if there is none, or nothing precedes it."""
    name = Path(path).name.lower()
    return max((suffix for suffix in FORMATS if name[1:].endswith(suffix)), key=len, default="")


def _format(path: str | Path) -> Format:
    suffix = suffix_of(path)
    if not suffix:
        raise InputError(
            f"{path}: expected a file of Gaussians named *{', *'.join(FORMATS)}, found suffix {Path(path).suffix!r}"
        )
    return FORMATS[suffix]
