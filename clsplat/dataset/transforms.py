"""Read transforms.json in the dialects of NeRF's Blender scenes, instant-ngp and nerfstudio.

A camera consists of a camera-to-world matrix in OpenGL axes (x right, y up, z back) and intrinsics, given for the
whole file or per frame. nerfstudio's ``applied_transform`` is already contained in its cameras and points, and is
ignored.
"""

import json
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import LAST_ROW_TOLERANCE
from clsplat.config import DataConfig
from clsplat.dataset.decoding import SIZE_MAX, Dataset, PosedPhoto
from clsplat.dataset.finding import (
    checked_name,
    find_mask,
    locate,
    mask_folder,
    warn_of_missing,
    without_suffix,
)
from clsplat.dataset.lenses import Intrinsics
from clsplat.dataset.photos import photo_size
from clsplat.errors import InputError
from clsplat.formats.ply_container import read_points

PERSPECTIVE = ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE")
"""Accepted values of ``camera_model``. For all of them, the given distortion coefficients are used and missing ones
are zero."""

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
"""Keys of the distortion."""

GROUPS = (
    ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y"),
    ("camera_model", "is_fisheye"),
    COEFFICIENTS,
)
"""Keys that belong together: a frame that gives one of a group has none of the file's."""

TRAIN_LIST, TEST_LISTS = "train_filenames", ("val_filenames", "test_filenames")
"""Keys of nerfstudio's split: lists of frames to train on, and of held-out ones."""

Json = dict[str, Any]


def find_transforms(root: Path) -> list[tuple[Path, bool | None]]:
    """Find the files with the cameras of the dataset `root`.

    Returns
    -------
    list of (Path, bool or None)
        Each file with whether its photos are held out: ``transforms_train.json`` and ``transforms_test.json`` (or
        ``_val``); otherwise ``transforms.json`` with None, since it defines no split. Empty if there is neither.
    """
    train = root / "transforms_train.json"
    if train.is_file():
        others = [path for part in ("test", "val") if (path := root / f"transforms_{part}.json").is_file()]
        return [(train, False), *((path, True) for path in others[:1])]
    whole = root / "transforms.json"
    return [(whole, None)] if whole.is_file() else []


def read_dataset(root: Path, config: DataConfig) -> Dataset:
    """Read the transforms.json of the dataset `root` and locate its photos, masks and points.

    Parameters
    ----------
    root : Path
        Folder of the dataset, in which `find_transforms` finds a file.
    config : DataConfig
        Size of the photos, folder of the masks (takes precedence over the frames' ``mask_path``).

    Returns
    -------
    Dataset
        Photos without a file, or in none of nerfstudio's lists, are left out with a warning. Points are read from
        ``ply_file_path``.

    Raises
    ------
    PhotosMissing
        If no photo is found.
    InputError
        If a file is damaged, a value is missing or not a number, or a mask is missing; the message names it.
    """
    metas = [(path, held_out, _read_json(path)) for path, held_out in find_transforms(root)]
    frames = [
        (_complete(frame, meta), path, part)
        for path, held_out, meta in metas
        for frame, part in (_split(meta, path) if held_out is None else [(f, held_out) for f in meta["frames"]])
    ]
    names = [checked_name(frame["file_path"], path) for frame, path, _ in frames]
    faces = config.panoramas == "faces"
    cut = [faces and frame.get("camera_model") == "EQUIRECTANGULAR" for frame, _, _ in frames]
    files, reduce, downscale = locate(root, names, config.downscale, cut)
    warn_of_missing(metas[0][0], names, files)
    masks = None if config.masks is None else mask_folder(root, config.masks)
    photos = []
    for (frame, path, held_out), name, file in zip(frames, names, files, strict=True):
        if file is None:
            continue
        if without_suffix(name) == name and not name.endswith(file.suffix):
            name += file.suffix
        intrinsics = _intrinsics(frame, f"{path}, frame {name}", file, downscale // reduce)
        if masks is not None:
            inside = name if (masks / "images").is_dir() else name.removeprefix("images/")
            mask: Path | None = find_mask(masks, inside)
        else:
            mask = root / checked_name(frame["mask_path"], path) if "mask_path" in frame else None
        photos.append(PosedPhoto(name, file, _viewmat(frame, path, name), intrinsics, mask, held_out))
    points, colors = _read_points(root, metas[0][2], metas[0][0])
    return Dataset(photos, points, colors, reduce, downscale)


def _read_json(path: Path) -> Json:
    """Read a file and check its frames; null means the same as a missing value."""
    try:
        meta = json.loads(path.read_text(encoding="utf-8-sig"), object_hook=_without_null)
    except (RecursionError, ValueError) as error:
        raise InputError(f"cannot read {path} as JSON: {error}") from error
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f'{path}: expected a list "frames" with at least one frame, found none')
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f'{path}: expected a "file_path" in every frame, found none in frame {number}')
    return dict(meta)


def _without_null(values: Json) -> Json:
    return {key: value for key, value in values.items() if value is not None}


def _complete(frame: Json, meta: Json) -> Json:
    """Add the values of the whole file to a frame."""
    own = {key for group in GROUPS if not frame.keys().isdisjoint(group) for key in group}
    return {**{key: value for key, value in meta.items() if key not in own}, **frame}


def _split(meta: Json, path: Path) -> list[tuple[Json, bool | None]]:
    """List the frames with whether nerfstudio's lists hold them out, None without lists.

    As in nerfstudio, a list of frames to train on leaves out those in no list.
    """
    frames = meta["frames"]
    names = [checked_name(frame["file_path"], path) for frame in frames]
    lists = {key: _listed(meta[key], key, names, path) for key in (TRAIN_LIST, *TEST_LISTS) if meta.get(key)}
    if not lists:
        return [(frame, None) for frame in frames]
    train = lists.pop(TRAIN_LIST, set(names))
    test = set[str]().union(*lists.values())
    unlisted = [name for name in names if name not in train | test]
    if unlisted:
        warnings.warn(
            f"{path}: {len(unlisted)} of {len(names)} photos are in none of the lists {TRAIN_LIST}, "
            f"{', '.join(TEST_LISTS)} and are left out (first: {unlisted[0]})",
            stacklevel=3,
        )
    return [(f, name in test) for f, name in zip(frames, names, strict=True) if name in train | test]


def _listed(found: Any, key: str, names: list[str], path: Path) -> set[str]:
    """Check one of nerfstudio's lists."""
    listed = {checked_name(name, path) for name in found} if isinstance(found, list) else set[str]()
    if listed.isdisjoint(names):
        raise InputError(
            f'{path}: expected a list of the "file_path" of frames as {key}, found none of them in {str(found)[:80]}'
        )
    return listed


def _number(frame: Json, key: str, where: str) -> float | None:
    if key not in frame:
        return None
    value = frame[key]
    if not _is_number(value):
        raise InputError(f"{where}: expected a finite number as {key}, found {str(value)[:80]!r}")
    return float(value)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an int larger than any float
        return False


def _number_or(default: float, frame: Json, key: str, where: str) -> float:
    value = _number(frame, key, where)
    return default if value is None else value


def _intrinsics(frame: Json, where: str, file: Path, downscaled: int) -> Intrinsics:
    """Read the intrinsics of a frame, at its declared size; by default that of the file times `downscaled`."""
    stored = photo_size(file)
    width = round(_number_or(stored[0] * downscaled, frame, "w", where))
    height = round(_number_or(stored[1] * downscaled, frame, "h", where))
    if not (1 <= width <= SIZE_MAX and 1 <= height <= SIZE_MAX):
        raise InputError(f"{where}: expected 1 to {SIZE_MAX} pixels per edge in w and h, found {width}x{height}")
    model = frame.get("camera_model", "OPENCV_FISHEYE" if frame.get("is_fisheye") else "OPENCV")
    if model == "EQUIRECTANGULAR":
        return Intrinsics("EQUIRECTANGULAR", (float(width), float(height)), width, height)
    fx, fy = _focal(frame, "x", width, where), _focal(frame, "y", height, where)
    fx, fy = fx or fy, fy or fx  # a single focal length means square pixels
    if fx is None or fy is None:
        raise InputError(f"{where}: expected fl_x or camera_angle_x, found neither")
    cx, cy = _number_or(width / 2, frame, "cx", where), _number_or(height / 2, frame, "cy", where)

    k1, k2, k3, k4, k5, k6, p1, p2 = (_number_or(0.0, frame, key, where) for key in COEFFICIENTS)
    if model in FISHEYE:
        if p1 or p2 or k5 or k6:
            raise InputError(f"{where}: expected only k1 to k4 for a {model} camera, found p1, p2, k5 or k6")
        return Intrinsics("OPENCV_FISHEYE", (fx, fy, cx, cy, k1, k2, k3, k4), width, height)
    if model not in PERSPECTIVE:
        raise InputError(
            f"{where}: expected a camera_model among {', '.join(PERSPECTIVE + FISHEYE)} and EQUIRECTANGULAR, found "
            f"{model!r}"
        )
    if not any((k1, k2, k3, k4, k5, k6, p1, p2)):
        return Intrinsics("PINHOLE", (fx, fy, cx, cy), width, height)
    if (k4 or k5 or k6) and model != "FULL_OPENCV":
        # In nerfstudio k4 is the coefficient of r^8, in OpenCV it is in the denominator. The file does not say which.
        raise InputError(f"{where}: expected at most k1, k2, k3, p1, p2 for a {model} camera, found k4, k5 or k6")
    return Intrinsics("FULL_OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6), width, height)


def _focal(frame: Json, axis: str, edge: int, where: str) -> float | None:
    focal = _number(frame, f"fl_{axis}", where)
    angle = _number(frame, f"camera_angle_{axis}", where)
    if focal is None and angle is not None:
        if not 0 < angle < np.pi:
            raise InputError(f"{where}: expected camera_angle_{axis} between 0 and pi, found {angle}")
        focal = float(edge / 2 / np.tan(angle / 2))
    if focal is not None and focal <= 0:
        raise InputError(f"{where}: expected a positive fl_{axis}, found {focal}")
    return focal


def _viewmat(frame: Json, path: Path, name: str) -> NDArray[np.float64]:
    """Convert a frame's matrix to a viewmat: world to camera, in OpenCV axes."""
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        matrix = np.empty(0)
    viewmat = np.eye(4)
    if matrix.shape == (4, 4) and np.abs(matrix[3] - (0, 0, 0, 1)).max() > LAST_ROW_TOLERANCE:
        raise InputError(
            f"{path}: expected 0, 0, 0, 1 in the last row of the transform_matrix of frame {name}, found "
            f"{matrix[3].tolist()}; transpose a matrix whose translation is in its last row"
        )
    if matrix.shape in ((4, 4), (3, 4)):
        rotation = matrix[:3, :3] * (1.0, -1.0, -1.0)
        viewmat[:3, :3] = rotation.T
        with np.errstate(over="ignore", invalid="ignore"):  # numbers of a damaged file; rejected below
            viewmat[:3, 3] = -rotation.T @ matrix[:3, 3]
    else:
        viewmat[:] = np.nan
    if not np.isfinite(viewmat).all():
        raise InputError(f"{path}: expected a finite 4x4 transform_matrix for frame {name}, found none or another")
    return viewmat


def _read_points(root: Path, meta: Json, source: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read the positions (P, 3) and colours (P, 3) of ``ply_file_path``; points without colours become grey."""
    if "ply_file_path" not in meta:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)
    path = root / checked_name(meta["ply_file_path"], source)
    try:
        with path.open("rb") as file:
            vertices = read_points(path, file)
    except OSError as error:
        raise InputError(f"cannot read {path}, the points of {source.name}: {error.strerror}") from error
    with np.errstate(invalid="ignore"):  # the cast of a signalling NaN
        points = np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    if not np.isfinite(points).all():
        raise InputError(f"{path}: expected finite points, found NaN or infinity")
    channels = ("red", "green", "blue")
    if not set(channels) <= set(vertices.dtype.names or ()):
        return points, np.full(points.shape, 128, dtype=np.uint8)
    colors = np.stack([vertices[channel] for channel in channels], axis=-1)
    if colors.dtype != np.uint8:
        raise InputError(f"{path}: expected colours of type uchar, found {colors.dtype}")
    return points, colors
