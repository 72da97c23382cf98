"""Locate the files of a dataset's photos and masks from the names that its cameras give."""

import warnings
from collections.abc import Sequence
from math import ceil, pi, sqrt
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Literal

from clsplat.config import MOST_DOWNSCALE
from clsplat.dataset.photos import SUFFIXES, photo_size
from clsplat.errors import InputError

SCREEN = 1920 * 1080
"""Most pixels of a photo with ``--downscale auto``: those of a screen. The time of a step is in proportion to them.
The code of Kerbl et al. 2023 reduces photos to a width of 1600, for the same reason."""

PANORAMA = pi**2 / 2
"""Pixels of a panorama for each pixel of a face of its cube: a face is a panorama's width over pi wide."""

DOWNSCALES = (2, 4, 8, MOST_DOWNSCALE)
"""Values of ``--downscale`` that messages recommend."""


class PhotosMissing(InputError):
    """No photo of a dataset was found."""


def checked_name(name: Any, source: Path) -> str:
    """Check a path inside a dataset and return it with forward slashes and without ``./``.

    Raises
    ------
    InputError
        If it is not text, is empty or absolute, or leads out of the dataset; the message names the file `source` that
        contains it.
    """
    path = PurePosixPath(name.replace("\\", "/")) if isinstance(name, str) else PurePosixPath()
    if not path.parts or path.is_absolute() or PureWindowsPath(name).drive or ".." in path.parts or "\0" in name:
        raise InputError(f"{source}: expected the names of photos inside the dataset's folder, found {name!r}")
    return path.as_posix()


def without_suffix(name: str) -> str:
    """Remove the suffix of a photo's name. In ``render.0001``, as Blender writes it, what follows the dot is none."""
    suffix = PurePosixPath(name).suffix
    return name.removesuffix(suffix) if suffix.lower() in SUFFIXES else name


def locate(
    root: Path, names: Sequence[str], downscale: int | Literal["auto"], cut: Sequence[bool] = ()
) -> tuple[list[Path | None], int, int]:
    """Locate the files of photos, in the requested size if the dataset has it.

    Parameters
    ----------
    root : Path
        Folder of the dataset.
    names : sequence of str
        Paths inside `root`, checked by `checked_name`. The suffix may be missing or differ from the file's.
    downscale : int or "auto"
        Requested reduction. For 2, ``images_2/a.jpg`` is preferred to ``images/a.jpg``, unless it exists for fewer
        photos; others likewise. "auto": the smallest with which no photo has more than `SCREEN` pixels, or that of
        the largest copies if there are only copies.
    cut : sequence of bool
        Whether each photo is a panorama that is cut into faces, which then have at most `SCREEN` pixels. Default:
        none is.

    Returns
    -------
    files : list of Path or None
        One entry per name; None if it has no file. At least one is not None.
    reduce : int
        Factor by which the files are still to be reduced: 1 if they already have the requested size.
    downscale : int
        The reduction.

    Raises
    ------
    PhotosMissing
        If no photo is found; the message names the smaller sizes that exist.
    InputError
        If the size of a photo cannot be read, where "auto" needs it; the message names it.
    """
    full = _files(root, names)
    found = sum(file is not None for file in full)
    copies = [] if found else [d for d in DOWNSCALES if any(file is not None for file in _files(root, names, d))]
    if downscale == "auto":
        downscale = copies[0] if copies else _fitting(full, cut or [False] * len(full))
    if downscale > 1:
        small = _files(root, names, downscale)
        found_small = sum(file is not None for file in small)
        if found_small >= max(found, 1):
            return small, 1, downscale
        if found_small:
            warnings.warn(
                f"{root}: copies {downscale} times smaller exist for only {found_small} of {found} photos; all "
                "photos are reduced from the full size instead",
                stacklevel=2,
            )
    if found:
        return full, downscale, downscale
    raise PhotosMissing(
        f"cannot find any of the {len(names)} photos, the first of them {root / names[0]}"
        + (f"; smaller copies exist: use downscale {' or '.join(map(str, copies))}" if copies else "")
    )


def _fitting(files: Sequence[Path | None], cut: Sequence[bool]) -> int:
    """The smallest reduction with which no photo, or no face of a panorama, exceeds a screen; 1 of no photos."""
    pairs = [(photo_size(file), faces) for file, faces in zip(files, cut, strict=True) if file is not None]
    largest = max((width * height / (PANORAMA if faces else 1) for (width, height), faces in pairs), default=0)
    return min(MOST_DOWNSCALE, max(1, ceil(sqrt(largest / SCREEN))))


def warn_of_missing(source: Path, names: Sequence[str], files: Sequence[Path | None]) -> None:
    """Warn, once, about the photos that `source` names but that have no file."""
    missing = [name for name, file in zip(names, files, strict=True) if file is None]
    if missing:
        warnings.warn(
            f"{source}: {len(missing)} of {len(names)} photos have no file and are left out (first: {missing[0]})",
            stacklevel=3,
        )


def _files(root: Path, names: Sequence[str], downscale: int = 1) -> list[Path | None]:
    """The files of names. A file stands in for a name with another suffix only if it belongs to no other name."""
    places = [_place(root, name, downscale) for name in names]
    used = {place for place in places if _is_file(place)}
    files: list[Path | None] = []
    for place in places:
        file = place if place in used else _stand_in(place, used)
        files.append(file)
        if file is not None:
            used.add(file)
    return files


def _place(root: Path, name: str, downscale: int) -> Path:
    """The path of a photo, or of its smaller copy, by its name."""
    folder, _, rest = name.partition("/")
    return root / (name if downscale == 1 else f"{folder}_{downscale}/{rest}")


def _stand_in(path: Path, used: set[Path]) -> Path | None:
    """A file with another suffix: smaller copies often have one, and the transforms of Blender scenes omit it."""
    stem = without_suffix(path.name)
    candidates = (path.with_name(stem + case) for suffix in SUFFIXES for case in (suffix, suffix.upper()))
    return next((file for file in candidates if file not in used and _is_file(file)), None)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # the name is longer than the file system allows
        return False


def find_mask(folder: Path, name: str) -> Path:
    """Locate the mask of the photo `name` in `folder`: for ``a.jpg``, ``a.png`` or ``a.jpg.png``.

    Raises
    ------
    InputError
        If the photo has no mask.
    """
    candidates = [folder / f"{without_suffix(name)}.png", folder / f"{name}.png"]
    for file in candidates:
        if _is_file(file):
            return file
    raise InputError(f"cannot find the mask of photo {name}: neither {candidates[0]} nor {candidates[1].name} exists")


def mask_folder(root: Path, masks: str, setting: str = "--masks") -> Path:
    """Locate the folder of masks: `masks` inside the dataset `root`, or relative to the working directory.

    Folders of other files by photo are found in the same way; `setting` names theirs in the message.

    Raises
    ------
    InputError
        If neither exists.
    """
    for folder in (root / masks, Path(masks)):
        if folder.is_dir():
            return folder
    raise InputError(f"{setting}: expected a folder, found neither {root / masks} nor {Path(masks)}")
