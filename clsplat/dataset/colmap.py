"""Read COLMAP models, binary and text. The layout is described in COLMAP's documentation, "Output Format"."""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config import DataConfig
from clsplat.dataset.decoding import SIZE_MAX, Dataset, PosedPhoto
from clsplat.dataset.finding import PhotosMissing, checked_name, find_mask, locate, mask_folder, warn_of_missing
from clsplat.dataset.lenses import Intrinsics
from clsplat.errors import InputError

MODELS: tuple[tuple[str, int], ...] = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
"""COLMAP's camera models: name and number of parameters. The index is the model's number in binary files."""

FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", ".")
"""Folders of a dataset that are searched for a model, in this order."""


class Model(NamedTuple):
    """Content of a model.

    cameras: by id; photos: name, camera id and viewmat of each; points (P, 3): in world units; colors (P, 3): theirs;
    shown: rows of the points whose features a photo has, by its name.
    """

    cameras: dict[int, Intrinsics]
    photos: list[tuple[str, int, NDArray[np.float64]]]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    shown: dict[str, NDArray[np.intp]]


def find_model(root: Path) -> Path | None:
    """Find the folder of the COLMAP model of the dataset `root`; None if it has no model."""
    for folder in FOLDERS:
        if any((root / folder / f"cameras.{ending}").is_file() for ending in ("bin", "txt")):
            return root / folder
    return None


def read_dataset(root: Path, model: Path, config: DataConfig, photos: Path | None = None) -> Dataset:
    """Read a COLMAP model and locate its photos and masks.

    Parameters
    ----------
    root : Path
        Folder of the dataset. Photos are searched in its folder ``images`` (``images_2`` etc. for
        `config.downscale` 2 etc.), then in `root` itself.
    model : Path
        Folder of the model.
    config : DataConfig
        Size of the photos, folder of the masks.
    photos : Path, optional
        Folder to search for photos instead of `root`. The model then describes the photos turned upright.

    Returns
    -------
    Dataset
        Photos without a file are left out with a warning.

    Raises
    ------
    PhotosMissing
        If no photo is found.
    InputError
        If a file is damaged or contradicts another, or a mask is missing; the message names it.
    """
    cameras, images, points, colors, shown = read_model(model)
    names = [name for name, _, _ in images]
    folder = root if photos is None else photos
    faces = config.panoramas == "faces"
    cut = [faces and cameras[camera].model == "EQUIRECTANGULAR" for _, camera, _ in images]
    try:
        files, reduce, downscale = locate(folder, [f"images/{name}" for name in names], config.downscale, cut)
    except PhotosMissing as error:
        try:
            files, reduce, downscale = locate(folder, names, config.downscale, cut)
        except PhotosMissing:
            raise error from None
    warn_of_missing(model, names, files)
    masks = None if config.masks is None else mask_folder(root, config.masks)
    return Dataset(
        [
            PosedPhoto(name, file, viewmat, cameras[camera], None if masks is None else find_mask(masks, name))
            for (name, camera, viewmat), file in zip(images, files, strict=True)
            if file is not None
        ],
        points,
        colors,
        reduce,
        downscale,
        upright=photos is not None,
        shown=shown,
    )


def read_model(folder: Path) -> Model:
    """Read ``cameras``, ``images`` and ``points3D``, each from ``.bin`` if it exists, otherwise from ``.txt``.

    Raises
    ------
    InputError
        If a file is missing or damaged, or there are no images; the message names the file.
    """
    cameras_path, cameras = _read(folder, "cameras", _cameras_bin, _cameras_txt)
    images_path, images = _read(folder, "images", _images_bin, _images_txt)
    points_path, points = _read(folder, "points3D", _points_bin, _points_txt)

    by_id: dict[int, Intrinsics] = {}
    for number, model, width, height, params in cameras:
        if not (1 <= width <= SIZE_MAX and 1 <= height <= SIZE_MAX) or not np.isfinite(params).all():
            raise InputError(
                f"{cameras_path}: expected finite parameters and 1 to {SIZE_MAX} pixels per edge, found "
                f"{width}x{height}, {params} for camera {number}"
            )
        if number in by_id:
            raise InputError(f"{cameras_path}: expected one camera of number {number}, found two; remove one of them")
        by_id[number] = Intrinsics(model, params, width, height)
    posed, by_number = [], {}
    for number, name, camera, quat, translation in images:
        if camera not in by_id:
            raise InputError(f"{images_path}: expected camera {camera} of photo {name} in {cameras_path.name}")
        posed.append((checked_name(name, images_path), camera, _viewmat(quat, translation, name, images_path)))
        by_number[number] = name
    if not posed:
        raise InputError(f"{images_path}: expected at least one photo with a pose, found none")
    found = list(points)
    rows = np.array([row for row, _ in found]).reshape(-1, 6)
    if not np.isfinite(rows).all() or ((rows[:, 3:] < 0) | (rows[:, 3:] > 255)).any():
        raise InputError(f"{points_path}: expected finite points with colours from 0 to 255, found others")
    shown = _shown([track for _, track in found], by_number)
    return Model(by_id, posed, rows[:, :3].copy(), rows[:, 3:].astype(np.uint8), shown)


def _shown(tracks: list[NDArray[np.int64]], names: dict[int, str]) -> dict[str, NDArray[np.intp]]:
    """Rows of points by the name of a photo, from the numbers of the photos that show each point."""
    photos = np.concatenate([np.zeros(0, np.int64), *tracks])
    rows = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    order = np.argsort(photos, kind="stable")
    numbers, starts = np.unique(photos[order], return_index=True)
    parts = np.split(rows[order], starts[1:])
    return {names[k]: np.unique(part) for k, part in zip(numbers.tolist(), parts, strict=False) if k in names}


def _read(folder: Path, name: str, read_bin: Any, read_txt: Any) -> tuple[Path, Iterator[Any]]:
    for path, read in ((folder / f"{name}.bin", read_bin), (folder / f"{name}.txt", read_txt)):
        if path.is_file():
            return path, read(path)
    raise InputError(f"cannot find {folder / name}.bin or {name}.txt")


def _viewmat(quat: Any, translation: Any, name: str, path: Path) -> NDArray[np.float64]:
    largest = max(map(abs, quat))  # scaled down first: the squares of a damaged file's numbers may overflow
    known = 0 < largest < np.inf and np.isfinite((*quat, *translation)).all()
    scaled = np.array(quat) / largest if known else np.full(4, np.nan)
    w, x, y, z = scaled / np.linalg.norm(scaled)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = translation
    if not np.isfinite(viewmat).all():
        raise InputError(f"{path}: expected a finite pose, found {quat}, {translation} for photo {name}")
    return viewmat


class _Bytes:
    """A binary file that is read from front to back, with an InputError instead of a read beyond its end."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        self._expect(layout.size)
        self.at += layout.size
        return layout.unpack_from(self.data, self.at - layout.size)

    def count(self) -> int:
        return int(self.take(struct.Struct("<Q"))[0])

    def skip(self, size: int) -> None:
        self.at += size

    def integers(self, count: int) -> NDArray[np.int64]:
        """Unsigned integers of four bytes."""
        self._expect(4 * count)
        self.at += 4 * count
        return np.frombuffer(self.data, "<u4", count, self.at - 4 * count).astype(np.int64)

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            self._expect(len(self.data))
        start, self.at = self.at, end + 1
        return os.fsdecode(self.data[start:end])

    def end(self) -> None:
        if self.at != len(self.data):
            raise InputError(f"{self.path}: expected {self.at} bytes by the counts in it, found {len(self.data)}")

    def _expect(self, size: int) -> None:
        if size > len(self.data) - self.at:
            raise InputError(
                f"{self.path}: expected {size} more bytes at byte {self.at}, found {len(self.data) - self.at}; the "
                "file is truncated or damaged"
            )


def _cameras_bin(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    file = _Bytes(path)
    head = struct.Struct("<IiQQ")
    for _ in range(file.count()):
        number, model, width, height = file.take(head)
        if not 0 <= model < len(MODELS):
            raise InputError(
                f"{path}: expected camera models 0 to {len(MODELS) - 1}, found {model} for camera {number}"
            )
        yield number, MODELS[model][0], width, height, file.take(struct.Struct(f"<{MODELS[model][1]}d"))
    file.end()


def _images_bin(path: Path) -> Iterator[tuple[int, str, int, tuple[float, ...], tuple[float, ...]]]:
    file = _Bytes(path)
    head = struct.Struct("<I7dI")
    for _ in range(file.count()):
        number, *pose, camera = file.take(head)
        name = file.text()
        file.skip(24 * file.count())  # keypoints: x, y and id of the point
        yield number, name, camera, tuple(pose[:4]), tuple(pose[4:])
    file.end()


def _points_bin(path: Path) -> Iterator[tuple[tuple[float, ...], NDArray[np.int64]]]:
    file = _Bytes(path)
    head = struct.Struct("<Q3d3Bd")
    for _ in range(file.count()):
        row = file.take(head)
        track = file.integers(2 * file.count())  # image id and index of the keypoint
        yield row[1:7], track[::2]
    file.end()


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    text = path.read_text(encoding="utf-8-sig", errors="surrogateescape")
    yield from ((number, line.strip()) for number, line in enumerate(text.split("\n"), 1))


def _damaged(path: Path, number: int, expected: str, line: str) -> InputError:
    return InputError(f"{path}, line {number}: expected {expected}, found {line[:80]!r}")


def _cameras_txt(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    counts = dict(MODELS)
    for number, line in _lines(path):
        if line and not line.startswith("#"):
            try:
                camera, model, width, height, *params = line.split()
                row = int(camera), model, int(width), int(height), tuple(map(float, params))
            except ValueError as error:
                raise _damaged(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", line) from error
            if counts.get(model) != len(params):
                wanted = f"{counts[model]} parameters" if model in counts else f"one of {', '.join(counts)}"
                raise _damaged(path, number, f"{wanted} for camera {camera}", line)
            yield row


def _images_txt(path: Path) -> Iterator[tuple[int, str, int, tuple[float, ...], tuple[float, ...]]]:
    lines = _lines(path)
    for number, line in lines:
        if line and not line.startswith("#"):
            try:
                image, qw, qx, qy, qz, tx, ty, tz, camera, name = line.split(maxsplit=9)
                quat, translation = map(float, (qw, qx, qy, qz)), map(float, (tx, ty, tz))
                row = int(image), name, int(camera), tuple(quat), tuple(translation)
            except ValueError as error:
                raise _damaged(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line) from error
            yield row
            next(lines, None)  # the line of its keypoints, which may be empty


def _points_txt(path: Path) -> Iterator[tuple[tuple[float, ...], NDArray[np.int64]]]:
    for number, line in _lines(path):
        if line and not line.startswith("#"):
            words = line.split()
            try:
                x, y, z, r, g, b = words[1:7]
                row = float(x), float(y), float(z), float(int(r)), float(int(g)), float(int(b))
                track = np.array(words[8::2], np.int64)  # image ids; the indices of keypoints are between them
            except (OverflowError, ValueError) as error:
                raise _damaged(path, number, "POINT3D_ID X Y Z R G B ERROR (IMAGE_ID POINT2D_IDX)*", line) from error
            yield row, track
