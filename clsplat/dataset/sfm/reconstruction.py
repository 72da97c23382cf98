"""Recover cameras and sparse points from photos, by COLMAP through pycolmap.

Structure from motion consists of SIFT on the CPU, matching and incremental mapping: Schoenberger and Frahm 2016,
doi:10.1109/CVPR.2016.445; global mapping: Pan et al. 2024, "Global structure-from-motion revisited".
"""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any

from clsplat.atomic import replacing
from clsplat.config import SfmConfig

# This also imports Pillow before pycolmap. Loaded after pycolmap 4.2.1, Pillow uses parts of the zlib inside pycolmap
# and crashes when it writes a PNG.
from clsplat.dataset.photos import (
    FRAMES,
    is_plain,
    list_photos,
    photo_folder,
    read_photo,
    write_upright_png,
)
from clsplat.dataset.sfm.matching import is_sliver, quiet
from clsplat.dataset.sfm.processes import apart
from clsplat.errors import InputError, unwritable
from clsplat.ranges import check

RECORD = "clsplat_sfm.json"
"""Name of the file next to the model's folder ``0`` that records the photos and options from which the model was
made."""

GLOBAL_PHOTOS = 100
"""Fewest photos whose poses are found all at once: global mapping fails more often with few photos, incremental
mapping drifts with many (measured: docs/howto/large.md)."""

WORK, LOCK = ".clsplat_sfm_", "lock"
"""Beginning of the names of temporary folders, and name of the file in each that the process locks which uses it."""


def read_record(folder: Path) -> dict[str, Any] | None:
    """Read the record that `reconstruct` wrote about the model in `folder`.

    Returns
    -------
    dict or None
        ``photos``: folder of the photos, relative to `folder` or absolute; ``hashes``: BLAKE2 of each photo by name;
        ``options``: fields of the `SfmConfig`; ``registered``: number of poses. None if `folder` has no model made by
        `reconstruct`.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    path = folder / "sparse" / RECORD
    if not path.is_file():
        return None
    try:
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        check(SfmConfig(**record["options"]))
        if not isinstance(record["hashes"], dict) or not isinstance(record["registered"], int):
            raise TypeError("hashes or registered of another type")
        photos = str(record["photos"])
        (folder / photos).resolve().is_dir()  # raises an error for a text that cannot be a path
        return {**record, "photos": photos}
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f"cannot read {path}, the record of a structure from motion: {error!r}; delete its folder to recover the "
            "cameras again"
        ) from error


def recorded_photos(folder: Path, record: dict[str, Any]) -> Path:
    """Folder of the photos from which the model in `folder` was made.

    A record from elsewhere must not lead to other files: photos outside `folder` must be those that it describes.

    Raises
    ------
    InputError
        If the record names a folder outside `folder` with other photos.
    """
    photos: Path = folder / record["photos"]
    inside = photos.resolve().is_relative_to(folder.resolve())
    if not inside and photos.is_dir() and _hashes(photos) != record["hashes"]:
        raise InputError(
            f"{folder / 'sparse' / RECORD}: expected photos inside {folder}, or the photos outside from which the "
            f"cameras were recovered, found other photos in {photos}; recover the cameras again with `clsplat sfm "
            f"{photos} -o {folder}`"
        )
    return photos


def _hashes(photos: Path) -> dict[str, str]:
    """BLAKE2 of each photo by its name."""
    folder = photo_folder(photos)
    return {
        name: hashlib.blake2b((folder / name).read_bytes(), digest_size=16).hexdigest()
        for name in list_photos(photos)
    }


def reconstruct(photos: Path, config: SfmConfig, output: Path | None = None, verbose: bool = False) -> Path:
    """Recover cameras and sparse points from photos; reuse the model if photos and options are unchanged.

    Parameters
    ----------
    photos : Path
        Folder with at least 3 overlapping photos, in itself or in its folder ``images`` (with sub-folders).
    config : SfmConfig
        Options.
    output : Path, optional
        Folder for the model; default: `photos`. The model records where the photos are, so that
        `clsplat.dataset.load_scene` can load this folder.
    verbose : bool
        Whether to show COLMAP's own messages.

    Returns
    -------
    Path
        ``sparse/0`` in `output`: the largest model, in COLMAP's binary format. It describes the photos turned upright
        by their EXIF orientation.

    Raises
    ------
    InputError
        If an option is out of range, there are too few photos, one is damaged, too few can be registered, or the
        output folder cannot be written or holds a model from elsewhere.
    """
    check(config, "sfm.")
    photos = Path(photos)
    output = photos if output is None else Path(output)
    if not photos.is_dir():
        raise InputError(f"{photos}: expected a folder of photos, found {'a file' if photos.exists() else 'nothing'}")
    folder, names = photo_folder(photos), list_photos(photos)
    if len(names) < config.min_registered:
        raise InputError(f"{folder}: expected at least {config.min_registered} photos, found {len(names)}")
    _remove_abandoned(output)
    hashes = _hashes(photos)
    model = output / "sparse" / "0"
    registered = _registered_before(output, hashes, config)
    if registered is not None:
        _check_registered(registered, len(names), photos, config)
        return model

    with _workspace(output) as work, quiet(verbose):
        readable = _readable(folder, names, work, config.max_image_size)
        registered = _solved(work, readable, names, _resolved(config, folder, len(names)), verbose)
        _check_registered(registered, len(names), photos, config)
        _check_written(work / "sparse" / "0", registered, output)
        where = "." if output.resolve() == photos.resolve() else str(photos.resolve())
        record = {"photos": where, "registered": registered, "options": asdict(config), "hashes": hashes}
        with replacing(work / "sparse" / RECORD) as file:
            file.write(json.dumps(record, indent=1).encode())
        if (output / "sparse").exists():
            os.replace(output / "sparse", work / "stale")
        os.replace(work / "sparse", output / "sparse")
    return model


def _registered_before(output: Path, hashes: dict[str, str], config: SfmConfig) -> int | None:
    """Number of poses of the model in `output`, if it was made from the same photos with the same options.

    Raises
    ------
    InputError
        If `output` holds a model from elsewhere.
    """
    record = read_record(output)
    if record is None and (output / "sparse").exists():
        raise InputError(
            f"{output / 'sparse'}: expected no such folder, or a model made by clsplat, found another model; remove "
            "it, or choose another folder with -o"
        )
    if record is None or record["hashes"] != hashes or not (output / "sparse" / "0" / "images.bin").is_file():
        return None
    # min_registered does not change the model; the caller checks the model against it.
    made_with = replace(SfmConfig(**record["options"]), min_registered=config.min_registered)
    return int(record["registered"]) if made_with == config else None


def _resolved(config: SfmConfig, folder: Path, count: int) -> SfmConfig:
    """Resolve `matching` and `mapper` "auto" for the photos in `folder`, `count` of them."""
    if config.matching == "auto":
        config = replace(config, matching="sequential" if (folder / FRAMES).is_file() else "exhaustive")
    if config.mapper == "auto":
        config = replace(config, mapper="global" if count >= GLOBAL_PHOTOS else "incremental")
    return config


def _check_registered(registered: int, count: int, photos: Path, config: SfmConfig) -> None:
    if registered < config.min_registered:
        raise InputError(
            f"cannot recover the cameras of {photos}: found the poses of {registered} of {count} photos, expected at "
            f"least {config.min_registered}; take more photos: sharp, overlapping by two thirds, from "
            "different positions, of a scene with texture"
        )


def _check_written(model: Path, registered: int, output: Path) -> None:
    """Raise an InputError if the files of a model are not whole. COLMAP does not notice that a disk fails."""
    from clsplat.dataset.colmap import read_model

    try:
        whole = len(read_model(model)[1]) == registered
    except InputError:
        whole = False
    if not whole:
        raise InputError(
            f"cannot write the recovered cameras to {output}: what was written is damaged; check the disk, and start "
            "again"
        )


@contextmanager
def _workspace(output: Path) -> Iterator[Path]:
    """Create a temporary folder inside `output`, so that its content can be moved to `output` by renaming."""
    elsewhere = (
        "copy the photos to a writable folder, or write the cameras elsewhere with `clsplat sfm PHOTOS -o DIR` and "
        "then use DIR instead of the photos"
    )
    try:
        output.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=WORK, dir=output))
        lock = (work / LOCK).open("w")
    except OSError as error:
        raise InputError(f"cannot write the recovered cameras to {output}: {error.strerror}; {elsewhere}") from error
    try:
        _locked(lock)
        if problem := unwritable(work):
            raise InputError(f"cannot write the recovered cameras to {output}: {problem}; {elsewhere}")
        yield work
    finally:
        lock.close()
        shutil.rmtree(work, ignore_errors=True)


def _locked(file: IO[str]) -> bool:
    """Lock an open file until it is closed or the process ends; False if another process has, or nothing can."""
    try:
        import fcntl
    except ImportError:  # Windows
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_abandoned(output: Path) -> None:
    """Remove the temporary folders of processes that were killed."""
    for work in output.glob(f"{WORK}*"):
        with suppress(OSError), (work / LOCK).open("w") as lock:
            if _locked(lock):
                shutil.rmtree(work)


def _readable(folder: Path, names: list[str], work: Path, edge_max: int) -> Path:
    """Provide a folder in which COLMAP reads the same pixels as training: `folder`, or a copy with converted photos.

    COLMAP ignores the EXIF orientation, and silently skips files that it cannot decode. Hence every photo is decoded
    here first.
    """
    from tqdm import tqdm

    def check(name: str) -> bool:
        height, width, _ = read_photo(folder / name, (0.0, 0.0, 0.0), upright=False).shape
        if is_sliver(width, height, edge_max):
            raise InputError(
                f"{folder / name}: expected an aspect ratio of at most {edge_max}, found {width}x{height} pixels"
            )
        return is_plain(folder / name)

    def copy(name: str, plain: bool) -> None:
        if not plain:
            return write_upright_png(folder / name, work / "photos" / name)
        (work / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder / name, work / "photos" / name)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        plain = list(tqdm(pool.map(check, names), "check photos", len(names), unit="photo", dynamic_ncols=True))
        if all(plain):
            return folder
        list(tqdm(pool.map(copy, names, plain), "turn photos", len(names), unit="photo", dynamic_ncols=True))
    return work / "photos"


def _solved(work: Path, folder: Path, names: list[str], config: SfmConfig, verbose: bool) -> int:
    """Run `solve` in a separate process."""
    registered: int = apart(
        "recover the cameras",
        "clsplat.dataset.sfm.solving:solve",
        work,
        folder=str(folder),
        names=names,
        options=asdict(config),
        verbose=verbose,
    )
    return registered
