"""Where the files of a dataset's photos and masks are."""

import warnings
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from clsplat.dataset.photos import SUFFIXES
from clsplat.errors import InputError


class PhotosMissing(InputError):
    """None of a dataset's photos was found."""


def checked_name(name: Any, source: Path) -> str:
    """A path inside a dataset with forward slashes and without ``./``.

    Raises
    ------
    InputError
        If it is no text, empty, absolute, or climbs out of the dataset; the message names the file `source` that
        has it.
    """
    path = PurePosixPath(name.replace("\\", "/")) if isinstance(name, str) else PurePosixPath()
    if not path.parts or path.is_absolute() or PureWindowsPath(name).drive or ".." in path.parts or "\0" in name:
        raise InputError(f"{source}: expected the names of photos inside the dataset's folder, found {name!r}")
    return path.as_posix()


def locate(root: Path, names: Sequence[str], downscale: int) -> tuple[list[Path | None], int]:
    """Find the files of photos, in the size asked for where the dataset has it.

    Parameters
    ----------
    root : Path
        The dataset's folder.
    names : sequence of str
        Paths inside it, checked; the ending may be missing or another one.
    downscale : int
        For 2, 4 or 8, ``images_2/a.jpg`` is preferred to ``images/a.jpg``, unless it exists for fewer photos.

    Returns
    -------
    files : list of Path or None
        Per name; None where there is no file. At least one is not None.
    reduce : int
        What remains of `downscale` after the choice of the folder.

    Raises
    ------
    PhotosMissing
        If none is found; the message says which sizes exist.
    """
    full = [_find(root, name) for name in names]
    found = sum(file is not None for file in full)
    if downscale > 1:
        small = [_find(root, name, downscale) for name in names]
        found_small = sum(file is not None for file in small)
        if found_small >= max(found, 1):
            return small, 1
        if found_small:
            warnings.warn(
                f"{root}: copies {downscale} times smaller exist for {found_small} of {found} photos only; all are "
                "resampled from the full size instead",
                stacklevel=2,
            )
    if found:
        return full, downscale
    sizes = [d for d in (2, 4, 8) if any(_find(root, name, d) is not None for name in names)]
    raise PhotosMissing(
        f"{root / names[0]}: expected this photo and {len(names) - 1} others, found none of them"
        + (f" but copies in smaller sizes: use downscale {' or '.join(map(str, sizes))}" if sizes else "")
    )


def warn_of_missing(source: Path, names: Sequence[str], files: Sequence[Path | None]) -> None:
    """Warn once of all the photos that `source` names and that have no file."""
    missing = [name for name, file in zip(names, files, strict=True) if file is None]
    if missing:
        warnings.warn(
            f"{source}: {len(missing)} of {len(names)} photos have no file and are left out (first: {missing[0]})",
            stacklevel=3,
        )


def _find(root: Path, name: str, downscale: int = 1) -> Path | None:
    folder, _, rest = name.partition("/")
    path = root / (name if downscale == 1 else f"{folder}_{downscale}/{rest}")
    if _is_file(path):
        return path
    # Smaller copies often have another ending, and Blender's transforms leave it out.
    stem = path.with_suffix("") if path.suffix.lower() in SUFFIXES else path
    candidates = (stem.with_name(stem.name + case) for suffix in SUFFIXES for case in (suffix, suffix.upper()))
    return next((file for file in candidates if _is_file(file)), None)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that is longer than the system's files have
        return False


def find_mask(folder: Path, name: str) -> Path:
    """File of the mask of the photo `name` in `folder`: ``NAME.png``, or ``NAME.jpg.png``.

    Raises
    ------
    InputError
        If there is none.
    """
    plain = folder / name
    candidates = [plain.with_suffix(".png"), plain.with_name(plain.name + ".png")]
    for file in candidates:
        if _is_file(file):
            return file
    raise InputError(
        f"{candidates[0]}: expected the mask of photo {name} there or in {candidates[1].name}, found none"
    )


def mask_folder(root: Path, masks: str) -> Path:
    """The folder of masks: `masks` inside the dataset `root` where that exists, otherwise from where we are.

    Raises
    ------
    InputError
        If it does not exist.
    """
    for folder in (root / masks, Path(masks)):
        if folder.is_dir():
            return folder
    raise InputError(f"masks: expected a folder, found none at {root / masks} nor at {Path(masks)}")
