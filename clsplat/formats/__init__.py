"""Files of Gaussians: a reader, a writer and an anatomy for each format. Some formats are only read or only written.

Belongs here: one module per format, and what formats share: `validity` (all of them), `quantisation` and `codebook`
(the compact ones), `axes` (those with other axes than PLY), containers (`ply_container`, `glb_container`,
`spz_container`, `sog_images`), `detail_tree` (those with levels of detail), `anatomy` (bytes by part). Does not
belong here: photos, cameras and datasets (`clsplat.dataset`), and pruning a scene until it fits (`clsplat.pruning`).
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
    glb_anatomy,
    ksplat_anatomy,
    ply_anatomy,
    sog_anatomy,
    splat_anatomy,
    spz_anatomy,
    streamed_sog_anatomy,
    tiles_anatomy,
)
from clsplat.formats.compressed_ply import load_compressed_ply, save_compressed_ply
from clsplat.formats.csv_table import save_csv
from clsplat.formats.gltf import load_glb, save_glb
from clsplat.formats.ksplat import load_ksplat
from clsplat.formats.ply import load_ply, save_ply
from clsplat.formats.sog import META, load_sog, save_sog
from clsplat.formats.splat import load_splat, save_splat
from clsplat.formats.spz import load_spz, save_spz
from clsplat.formats.streamed_sog import LOD_META, load_streamed_sog
from clsplat.formats.tiles_3d import TILESET, load_tiles
from clsplat.formats.usda import save_usda
from clsplat.gaussians import Gaussians

__all__ = ["FORMATS", "READ_ONLY", "WRITE_ONLY", "Format", "load_gaussians", "save_gaussians"]

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
    ".glb": Format(load_glb, save_glb, glb_anatomy),
}
"""Formats by the suffix of the file name. If several suffixes fit, the longest is used."""

READ_ONLY: dict[str, tuple[Loader, Callable[[Path], Anatomy]]] = {".ksplat": (load_ksplat, ksplat_anatomy)}
"""Reader and anatomy of the formats that are read but not written, by suffix."""

WRITE_ONLY: dict[str, Saver] = {".usda": save_usda, ".csv": save_csv}
"""Writers of the formats that are written but not read, by suffix."""

FOLDERS: dict[str, tuple[Loader, Callable[[Path], Anatomy]]] = {
    META: (load_sog, sog_anatomy),
    LOD_META: (load_streamed_sog, streamed_sog_anatomy),
    TILESET: (load_tiles, tiles_anatomy),
}
"""Reader and anatomy of scenes of several files, by the name of the one that describes them."""

SCENES = ("*", "point_cloud/iteration_*/point_cloud.ply", "scene.*")
"""Patterns of scenes in folders of runs, the last one that fits is meant: any file, that of the original code, and
that of ``clsplat train``."""


def load_gaussians(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a file in a format of `FORMATS` or `READ_ONLY`, chosen by its suffix, or from a folder with
    an unpacked or streamed SOG or 3D Tiles.

    Parameters
    ----------
    path : str or Path
        The file; for a scene of several files, its folder, or the meta.json, lod-meta.json or tileset.json in it.

    Returns
    -------
    gaussians : Gaussians
        float32, at least one.
    mode : {"classic", "antialiased"}
        Rendering mode for which the scene was trained, according to the file; classic if the format does not store
        it.
    offset : (3,) float64
        Offset that was subtracted from the world's coordinates, in world units; zeros if the format does not store
        it.

    Raises
    ------
    InputError
        If no format has this suffix, or the file is not a valid file of its format; the message names it.
    """
    return _readable(path)[0](path)


def anatomy_of(path: str | Path) -> Anatomy:
    """Describe the parts of a file or folder that `load_gaussians` has read.

    Raises
    ------
    InputError
        If no format has this suffix.
    """
    return _readable(path)[1](Path(path))


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
        Offset that was subtracted from the world's coordinates, in world units.

    Raises
    ------
    InputError
        If no format has this suffix, the Gaussians cannot be stored, or the file cannot be written.

    Warns
    -----
    UserWarning
        If the format cannot hold the mode, the offset, bands of the spherical harmonics or some values.
    """
    check_writable(path)
    suffix = suffix_of(path)
    save = WRITE_ONLY[suffix] if suffix in WRITE_ONLY else FORMATS[suffix].save
    save(path, gaussians, mode, offset)


def suffix_of(path: str | Path) -> str:
    """Return the suffix of a format at the end of a file's name; empty if there is none, or nothing precedes it."""
    name = Path(path).name.lower()
    known = (*FORMATS, *READ_ONLY, *WRITE_ONLY)
    return max((suffix for suffix in known if name[1:].endswith(suffix)), key=len, default="")


def described_by(path: str | Path) -> str | None:
    """Return the name of the file of `FOLDERS` that is `path`, or is in this folder; None if there is none."""
    path = Path(path)
    return next((name for name in FOLDERS if path.name == name or (path.is_dir() and (path / name).is_file())), None)


def check_writable(path: str | Path) -> None:
    """Raise an InputError unless the suffix of a file's name is that of a format that is written."""
    suffix = suffix_of(path)
    if suffix in READ_ONLY:
        raise InputError(
            f"{path}: expected a format that clsplat writes, found {suffix}, which it only reads; use .spz"
        )
    if not suffix:
        raise _unknown(path, (*FORMATS, *WRITE_ONLY))


def _readable(path: str | Path) -> tuple[Loader, Callable[[Path], Anatomy]]:
    """Return the reader and the anatomy of a file or folder."""
    described = described_by(path)
    if described is not None:
        return FOLDERS[described]
    if Path(path).is_dir():
        inside = [
            file for pattern in SCENES for file in sorted(Path(path).glob(pattern)) if suffix_of(file) in FORMATS
        ]
        hint = f"; the scene in it is {inside[-1]}" if inside else ""
        raise InputError(f"{path}: expected a file of Gaussians, such as scene.ply, found a folder{hint}")
    suffix = suffix_of(path)
    if suffix in WRITE_ONLY:
        raise InputError(
            f"{path}: expected a format that clsplat reads, found {suffix}, which it only writes; use the file "
            "it was made from"
        )
    if not suffix:
        if not Path(path).suffix and not Path(path).exists():
            raise InputError(f"{path}: expected a file of Gaussians or the folder of a run, found nothing")
        raise _unknown(path, (*FORMATS, *READ_ONLY))
    return READ_ONLY[suffix] if suffix in READ_ONLY else (FORMATS[suffix].load, FORMATS[suffix].anatomy)


def _unknown(path: str | Path, suffixes: tuple[str, ...]) -> InputError:
    return InputError(
        f"{path}: expected a file of Gaussians named *{', *'.join(suffixes)}, found suffix {Path(path).suffix!r}"
    )
