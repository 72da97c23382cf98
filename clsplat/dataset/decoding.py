"""From a dataset's photos and cameras to views: files found, distortion undone, pixels decoded and resampled."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from math import floor
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import BACKGROUNDS, DataConfig
from clsplat.dataset.lenses import Intrinsics, is_pinhole, project, rendered, undistorted
from clsplat.dataset.photos import is_transparent, orientation, photo_size, read_mask, read_photo
from clsplat.errors import InputError
from clsplat.panorama import FACES, bordered, face_positions, rotated
from clsplat.scene import View

SIZE_MAX = 1 << 20
"""Pixels per edge; a larger size is damage, and undistortion takes time in proportion to it."""

ASPECT_TOLERANCE = 0.01
"""By how much a photo's aspect ratio may differ from its camera's; a smaller copy is off by up to a pixel besides."""


@dataclass(frozen=True, eq=False)
class PosedPhoto:
    """A photo as a dataset declares it.

    Parameters
    ----------
    name : str
        Path of the photo inside its folder, with forward slashes.
    path : Path
        The file to decode.
    viewmat : (4, 4) float64
        World to camera, in world units.
    intrinsics : Intrinsics
        With distortion, at the size the dataset declares.
    mask : Path, optional
        File of its mask.
    held_out : bool, optional
        Whether the dataset keeps it for testing; None where it does not say.
    face : str, optional
        Of the panorama at `path`: the name of the face (`clsplat.panorama.FACES`) whose viewmat this is.
    """

    name: str
    path: Path
    viewmat: NDArray[np.float64]
    intrinsics: Intrinsics
    mask: Path | None = None
    held_out: bool | None = None
    face: str | None = None


def by_faces(photos: list[PosedPhoto]) -> list[PosedPhoto]:
    """The photos, with each equirectangular panorama, of viewmat, as six: ``a_front.jpg`` and so on for ``a.jpg``."""
    result = []
    for photo in photos:
        if photo.intrinsics.model != "EQUIRECTANGULAR":
            result.append(photo)
            continue
        name = PurePosixPath(photo.name)
        for face in FACES:
            named = name.with_name(f"{name.stem}_{face}{name.suffix}").as_posix()
            result.append(replace(photo, name=named, viewmat=rotated(photo.viewmat, face), face=face))
    return result


@dataclass(frozen=True, eq=False)
class Dataset:
    """What a reader finds out before any photo is decoded.

    Parameters
    ----------
    photos : list of PosedPhoto
        At least one.
    points : (P, 3) float64
        Sparse points, in world units; P may be 0.
    colors : (P, 3) uint8
        Their colours.
    reduce : int
        Edge of the squares of pixels that are averaged into one; 1 where the files have the size asked for.
    upright : bool
        The cameras describe the photos turned as their EXIF orientation says, not as they are stored.
    """

    photos: list[PosedPhoto]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    reduce: int = 1
    upright: bool = False


@dataclass(frozen=True, eq=False)
class _Plan:
    """How a photo becomes a view, known from the files' headers."""

    photo: PosedPhoto
    camera: Camera
    size: tuple[int, int]
    upright: bool
    invert_mask: bool


def load_views(dataset: Dataset, config: DataConfig) -> list[View]:
    """Decode a dataset's photos on several threads.

    All cameras and the headers of all files are checked before the first photo is decoded.

    Parameters
    ----------
    dataset : Dataset
        From a reader.
    config : DataConfig
        Its background is put behind transparent photos, and masks may be inverted.

    Returns
    -------
    list of View
        In the order of the dataset's photos: undistorted, reduced.

    Raises
    ------
    InputError
        If a pose is no rigid motion, a photo or mask cannot be decoded, or its shape is not its camera's; the message
        names it.
    """
    from tqdm import tqdm

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        plans = list(pool.map(lambda photo: _plan(photo, dataset, config.invert_masks), dataset.photos))
        views = pool.map(lambda plan: _view(plan, dataset.reduce, config), plans)
        return list(tqdm(views, "photos", len(plans), unit="photo", dynamic_ncols=True, leave=False))


def load_view(photo: PosedPhoto, dataset: Dataset, config: DataConfig) -> View:
    """Decode one of a dataset's photos, as `load_views` does, with its errors."""
    return _view(_plan(photo, dataset, config.invert_masks), dataset.reduce, config)


def _plan(photo: PosedPhoto, dataset: Dataset, invert_mask: bool) -> _Plan:
    declared = photo.intrinsics
    width, height = photo_size(photo.path)
    turned = orientation(photo.path) >= 5 if dataset.upright else False
    upright = dataset.upright
    if not upright and not _fits((width, height), declared) and _fits((height, width), declared):
        # The pixels as stored have the other aspect: the cameras were found on photos that a program had turned.
        upright = turned = orientation(photo.path) >= 5
    if turned:
        width, height = height, width
    if not _fits((width, height), declared):
        raise InputError(
            f"{photo.path}: expected a photo of {declared.width}x{declared.height} pixels or a smaller copy of it, "
            f"as its camera says, found {width}x{height}"
        )
    sx, sy = width / declared.width, height / declared.height
    if photo.face:
        # In the middle of a face, pixels are as small as on the panorama's equator.
        edge = round(width / np.pi / dataset.reduce) * dataset.reduce
        target = Intrinsics("PINHOLE", (edge / 2 / sx, edge / 2 / sy, edge / 2 / sx, edge / 2 / sy), 0, 0)
        across = down = edge
    else:
        target = rendered(declared)
        # An undistorted photo loses the last fraction of a pixel, one that is reduced what does not fill a square.
        across, down = floor(target.width * sx + 1e-6), floor(target.height * sy + 1e-6)
    fx, fy, cx, cy = (v * s / dataset.reduce for v, s in zip(target.params[:4], (sx, sy, sx, sy), strict=True))
    if min(across, down) < dataset.reduce:
        raise InputError(f"{photo.path}: expected at least {dataset.reduce} pixels per edge, found {across}x{down}")
    try:
        camera = Camera(photo.viewmat, fx, fy, cx, cy, across // dataset.reduce, down // dataset.reduce)
        if target.model == "OPENCV_FISHEYE":
            k1, k2, k3, k4 = target.params[4:]
            camera = replace(camera, model="fisheye", distortion=(k1, k2, k3, k4))
    except InputError as error:
        raise InputError(f"photo {photo.name}: {error}") from error
    return _Plan(photo, camera, (width, height), upright, invert_mask)


def _fits(size: tuple[int, int], declared: Intrinsics) -> bool:
    sx, sy = size[0] / declared.width, size[1] / declared.height
    # Rounding a smaller copy's size moves one edge by less than a pixel.
    return abs(sx - sy) <= max(ASPECT_TOLERANCE * max(sx, sy), 1 / min(declared.width, declared.height))


def _view(plan: _Plan, reduce: int, config: DataConfig) -> View:
    photo, camera = plan.photo, plan.camera
    image, mask = _pixels(plan, reduce, BACKGROUNDS[config.background])
    clear = None
    if config.random_background and is_transparent(photo.path):
        # What shows of the background is what changes with it.
        white, black = (_pixels(plan, reduce, BACKGROUNDS[name])[0].astype(float) for name in ("white", "black"))
        clear = np.rint((white - black).mean(axis=2)).astype(np.uint8)
    return View(photo.name, camera, np.ascontiguousarray(image), mask, clear)


def _pixels(
    plan: _Plan, reduce: int, background: tuple[float, float, float]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Photo and mask: decoded, undistorted, reduced."""
    photo, camera = plan.photo, plan.camera
    image = read_photo(photo.path, background, plan.upright)
    # Inverted before it is averaged: a pixel counts if all that it is made of does.
    mask = None if photo.mask is None else _fitted_mask(photo.mask, *image.shape[1::-1]) ^ plan.invert_mask
    positions = None
    if photo.face:
        positions = face_positions(photo.face, image.shape[1], image.shape[0], camera.width * reduce) + 1
        image, mask = bordered(image), None if mask is None else bordered(mask)
    elif camera.model == "pinhole" and not is_pinhole(photo.intrinsics):
        rows, columns = camera.height * reduce, camera.width * reduce
        positions = _positions(photo.intrinsics, plan.size, (rows, columns))
    if positions is not None:
        image = np.stack([_resample(image[..., channel], positions, 1) for channel in range(3)], axis=-1)
        mask = None if mask is None else _resample(mask, positions, 0)
    if reduce > 1:
        # Sum by sum: NumPy's mean over two axes of bytes takes several times as long.
        squares = _squares(image, camera, reduce)
        total = sum(squares[:, i, :, j].astype(np.uint16) for i in range(reduce) for j in range(reduce))
        image = np.rint(total / reduce**2).astype(np.uint8)
        # A pixel that is averaged from a masked one does not count either.
        mask = None if mask is None else np.asarray(_squares(mask, camera, reduce).all(axis=(1, 3)))
    if camera.model == "fisheye":
        seen = _image_circle(camera)
        if not seen.all():
            mask = seen if mask is None else mask & seen
    return image, mask


def _image_circle(camera: Camera) -> NDArray[np.bool_]:
    """Where a fisheye's image shows anything, (H, W): beyond, the lens's polynomial has no angle."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.asarray(np.isfinite(camera.rays(u, v)[..., 0]))


def _squares(pixels: NDArray[Any], camera: Camera, edge: int) -> NDArray[Any]:
    inside = pixels[: camera.height * edge, : camera.width * edge]
    return inside.reshape(camera.height, edge, camera.width, edge, *pixels.shape[2:])


def _fitted_mask(path: Path, width: int, height: int) -> NDArray[np.bool_]:
    """The mask at the photo's size: the nearest of its pixels where it has another one."""
    mask = read_mask(path)
    if not _fits((mask.shape[1], mask.shape[0]), Intrinsics("PINHOLE", (), width, height)):
        raise InputError(
            f"{path}: expected a mask of the photo's shape, {width}x{height} pixels or another size of it, found "
            f"{mask.shape[1]}x{mask.shape[0]}"
        )
    rows = ((np.arange(height) + 0.5) * mask.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * mask.shape[1] / width).astype(int)
    return mask[np.ix_(rows, columns)]


# Photos of one camera share it; photos with cameras of their own do not pile up.
@lru_cache(maxsize=2)
def _positions(intrinsics: Intrinsics, size: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Row and column indices, (2, H, W), at which an undistorted image's pixels lie in the distorted photo.

    `size` is the photo's width and height, `shape` the undistorted image's (H, W), in the same pixels.
    """
    sx, sy = size[0] / intrinsics.width, size[1] / intrinsics.height
    fx, fy, cx, cy = undistorted(intrinsics).params
    positions = np.empty((2, *shape), dtype=np.float32)
    with np.errstate(all="ignore"):  # what overflows is outside
        x = ((np.arange(shape[1]) + 0.5) / sx - cx) / fx
        y = ((np.arange(shape[0]) + 0.5) / sy - cy) / fy
        for row in range(shape[0]):
            rays = np.stack([x, np.full_like(x, y[row]), np.ones_like(x)], axis=-1)
            positions[1, row], positions[0, row] = (project(intrinsics, rays) * (sx, sy)).T
    # COLMAP looks at the photo's border alone; a pixel outside is more than the half that rounding may cost.
    inside = (positions > -1) & (positions < np.array(size[::-1]).reshape(2, 1, 1) + 1)
    if not inside.all():
        raise InputError(
            f"camera model {intrinsics.model}: expected a distortion that can be undone over the whole photo, found "
            f"parameters {intrinsics.params}"
        )
    return positions - np.float32(0.5)  # indices count from pixel centres


def _resample(channel: NDArray[Any], positions: NDArray[np.float32], order: int) -> NDArray[Any]:
    from scipy.ndimage import map_coordinates

    resampled: NDArray[Any] = map_coordinates(channel, positions, order=order, mode="nearest")
    return resampled
