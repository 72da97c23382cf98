"""Decode the photos of a dataset to `View` objects: undistorted, reduced, with their masks and cameras."""

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from math import floor
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import BACKGROUNDS, DataConfig
from clsplat.dataset.finding import DOWNSCALES
from clsplat.dataset.lenses import Intrinsics, import_models, is_pinhole, rendered
from clsplat.dataset.photos import is_transparent, orientation, photo_size, read_mask, read_photo
from clsplat.dataset.undistortion import lens_positions, resampled, squares_of
from clsplat.errors import InputError
from clsplat.host_memory import physical_memory
from clsplat.panorama import FACES, bordered, face_positions, rotated
from clsplat.scene import View
from clsplat.streaming import Files, PhotoStream, Source, photo_budget

SIZE_MAX = 1 << 20
"""Largest width or height of a photo, px. A larger declared size means a damaged file; undistortion would take time
in proportion to it."""

CHANNELS = 3
"""Bytes of a pixel of a decoded image."""

ASPECT_TOLERANCE = 0.01
"""Largest relative difference between the aspect ratios of a photo and its camera. The size of a smaller copy may
differ by up to a pixel in addition."""


@dataclass(frozen=True, eq=False)
class PosedPhoto:
    """A photo and its camera, as a dataset declares them.

    Parameters
    ----------
    name : str
        Path of the photo inside its folder, with forward slashes.
    path : Path
        The file to decode.
    viewmat : (4, 4) float64
        World to camera, in world units.
    intrinsics : Intrinsics
        Camera with its distortion, at the size that the dataset declares.
    mask : Path, optional
        File of the mask.
    held_out : bool, optional
        Whether the dataset assigns the photo to the test set; None if it does not define a split.
    face : str, optional
        Name of a face of a cube (`clsplat.panorama.FACES`), if this photo is a face of the panorama at `path`;
        `viewmat` is then that of the face.
    """

    name: str
    path: Path
    viewmat: NDArray[np.float64]
    intrinsics: Intrinsics
    mask: Path | None = None
    held_out: bool | None = None
    face: str | None = None


def by_faces(photos: list[PosedPhoto]) -> list[PosedPhoto]:
    """Replace each equirectangular panorama by six photos, the faces of a cube: ``a_front.jpg`` ... for ``a.jpg``."""
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
    """A dataset before its photos are decoded, as the readers return it.

    Parameters
    ----------
    photos : list of PosedPhoto
        At least one.
    points : (P, 3) float64
        Sparse points, in world units; P may be 0.
    colors : (P, 3) uint8
        RGB of the points.
    reduce : int
        Edge, in pixels, of the squares that are averaged to one pixel; 1 if the files have the requested size.
    downscale : int
        Factor by which the photos are smaller than at their full size: `reduce`, or that of the smaller copies.
    upright : bool
        Whether the cameras describe the photos turned by their EXIF orientation, rather than as stored.
    shown : mapping of str to (N,) int
        Rows of the points whose features a photo has, by its name; empty if they are not known.
    """

    photos: list[PosedPhoto]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    reduce: int = 1
    downscale: int = 1
    upright: bool = False
    shown: Mapping[str, NDArray[np.intp]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Plan:
    """Everything needed to decode a photo to a view, determined from the files' headers."""

    photo: PosedPhoto
    camera: Camera
    size: tuple[int, int]
    upright: bool
    invert_mask: bool


def load_views(dataset: Dataset, config: DataConfig, memory: int | None = None) -> list[View]:
    """Decode the photos of a dataset on several threads, now or, if they do not fit the memory, when they are needed.

    All cameras and the headers of all files are checked before the first photo is decoded.

    Parameters
    ----------
    dataset : Dataset
    config : DataConfig
        Background behind transparent photos; whether masks are inverted.
    memory : int, optional
        Bytes of decoded photos in memory. Default: `clsplat.streaming.PHOTO_SHARE` of the machine's memory.

    Returns
    -------
    list of View
        Undistorted and reduced photos, in the order of `dataset.photos`.

    Raises
    ------
    InputError
        If a pose is not a rigid motion, a photo or mask cannot be decoded, or its shape differs from its camera's;
        the message names it. If the largest photo does not fit the machine's memory.
    """
    from tqdm import tqdm

    import_models(photo.intrinsics for photo in dataset.photos)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        plans = list(pool.map(lambda photo: plan_view(photo, dataset, config.invert_masks), dataset.photos))
        sizes = list(pool.map(lambda plan: _decoded(plan, config), plans))
        _check_memory(plans, sizes, dataset.downscale)
        budget = photo_budget(memory)
        if budget is not None and sum(sizes) > budget:
            return _stream(plans, dataset.reduce, config, budget).views()
        views = pool.map(lambda plan: _view(plan, dataset.reduce, config), plans)
        return list(tqdm(views, "photos", len(plans), unit="photo", dynamic_ncols=True, leave=False))


def _check_memory(plans: list[Plan], sizes: list[int], downscale: int) -> None:
    """Raise an InputError if a file and what is decoded of it do not fit the machine."""
    files = [CHANNELS * plan.size[0] * plan.size[1] for plan in plans]
    k = max(range(len(plans)), key=lambda k: files[k] + sizes[k])
    available = physical_memory()
    if available is None or files[k] + sizes[k] <= available:
        return
    fitting = [d for d in DOWNSCALES if d > downscale and files[k] + sizes[k] * (downscale / d) ** 2 <= available]
    remedy = f"--downscale {fitting[0]}" if fitting else "use smaller photos"
    raise InputError(
        f"{plans[k].photo.path}: expected photos that fit this machine's memory of {available / 1e9:.2f} GB, found "
        f"one that takes {(files[k] + sizes[k]) / 1e9:.2f} GB; {remedy}"
    )


def _layers(plan: Plan, config: DataConfig) -> tuple[str, ...]:
    """Arrays that a decoded photo may have."""
    masked = plan.photo.mask is not None or plan.camera.model == "fisheye"
    clear = config.random_background and is_transparent(plan.photo.path)
    return "image", *["mask"] * masked, *["clear"] * clear


def _decoded(plan: Plan, config: DataConfig) -> int:
    """Bytes of a decoded photo, at most: one per pixel for each array beside the image."""
    return (CHANNELS + len(_layers(plan, config)) - 1) * plan.camera.width * plan.camera.height


def _stream(plans: list[Plan], reduce: int, config: DataConfig, memory: int) -> PhotoStream:
    """The photos, decoded when they are needed. Where that is more than reading the file, copies are kept on disk."""

    def source(plan: Plan) -> Source:
        layers = _layers(plan, config)

        def used() -> bool:
            mask = _mask(plan, reduce, _source_positions(plan, reduce)) if "mask" in layers else None
            return mask is None or bool(mask.any())

        return Source(lambda: _view(plan, reduce, config), plan.camera, layers, used)

    slow = reduce > 1 or any(plan.photo.face or not is_pinhole(plan.photo.intrinsics) for plan in plans)
    sources = {plan.photo.name: source(plan) for plan in plans}
    return PhotoStream(sources, memory, Files.temporary() if slow else None)


def load_view(photo: PosedPhoto, dataset: Dataset, config: DataConfig) -> View:
    """Decode one photo of a dataset; like `load_views`, with the same errors."""
    return _view(plan_view(photo, dataset, config.invert_masks), dataset.reduce, config)


def plan_view(photo: PosedPhoto, dataset: Dataset, invert_mask: bool) -> Plan:
    """Determine the camera of a photo's view from the headers of its file; errors as of `load_views`."""
    declared = photo.intrinsics
    width, height = photo_size(photo.path)
    turned = orientation(photo.path) >= 5 if dataset.upright else False
    upright = dataset.upright
    if not upright and not fits((width, height), declared) and fits((height, width), declared):
        # Width and height are swapped: the cameras were computed from photos that had been turned upright.
        upright = turned = orientation(photo.path) >= 5
    if turned:
        width, height = height, width
    if not fits((width, height), declared):
        raise InputError(
            f"{photo.path}: expected {declared.width}x{declared.height} pixels, the size of its camera, or a smaller "
            f"copy, found {width}x{height}"
        )
    if declared.model == "EQUIRECTANGULAR" and not fits((width, height), Intrinsics("", (), 2, 1)):
        raise InputError(
            f"{photo.path}: expected a panorama twice as wide as high, 360 by 180 degrees, found {width}x{height} "
            "pixels; pad what was cut off, and mask it"
        )
    sx, sy = width / declared.width, height / declared.height
    if photo.face is None and declared.model == "EQUIRECTANGULAR":
        whole = Camera.panorama(photo.viewmat, width)
        target, across, down = Intrinsics("", (whole.fx, whole.fy, whole.cx, whole.cy), 0, 0), width, height
        sx = sy = 1.0  # the panorama has the size of the file
    elif photo.face:
        # The centre of a face has as many pixels per angle as the equator of the panorama.
        edge = round(width / np.pi / dataset.reduce) * dataset.reduce
        target = Intrinsics("PINHOLE", (edge / 2 / sx, edge / 2 / sy, edge / 2 / sx, edge / 2 / sy), 0, 0)
        across = down = edge
    else:
        target = rendered(declared)
        # Undistortion cuts off the last fraction of a pixel; reduction cuts off pixels that do not fill a square.
        across, down = floor(target.width * sx + 1e-6), floor(target.height * sy + 1e-6)
    fx, fy, cx, cy = (v * s / dataset.reduce for v, s in zip(target.params[:4], (sx, sy, sx, sy), strict=True))
    if min(across, down) < dataset.reduce:
        raise InputError(f"{photo.path}: expected at least {dataset.reduce} pixels per edge, found {across}x{down}")
    try:
        camera = Camera(photo.viewmat, fx, fy, cx, cy, across // dataset.reduce, down // dataset.reduce)
        if target.model == "OPENCV_FISHEYE":
            k1, k2, k3, k4 = target.params[4:]
            camera = replace(camera, model="fisheye", distortion=(k1, k2, k3, k4))
        elif photo.face is None and declared.model == "EQUIRECTANGULAR":
            camera = replace(camera, model="equirectangular")
    except InputError as error:
        raise InputError(f"photo {photo.name}: {error}") from error
    return Plan(photo, camera, (width, height), upright, invert_mask)


def fits(size: tuple[int, int], declared: Intrinsics) -> bool:
    """Whether width and height are those of a camera, or of a smaller or larger copy."""
    sx, sy = size[0] / declared.width, size[1] / declared.height
    # Rounding a smaller copy's size moves one edge by less than a pixel.
    return abs(sx - sy) <= max(ASPECT_TOLERANCE * max(sx, sy), 1 / min(declared.width, declared.height))


def _view(plan: Plan, reduce: int, config: DataConfig) -> View:
    photo, camera = plan.photo, plan.camera
    positions = _source_positions(plan, reduce)
    image = _image(plan, reduce, BACKGROUNDS[config.background], positions)
    mask, clear = _mask(plan, reduce, positions), None
    if config.random_background and is_transparent(photo.path):
        # The visible share of the background is the difference between the photo on white and on black.
        white, black = (
            _image(plan, reduce, BACKGROUNDS[name], positions).astype(float) for name in ("white", "black")
        )
        clear = np.rint((white - black).mean(axis=2)).astype(np.uint8)
    return View(photo.name, camera, np.ascontiguousarray(image), mask, clear)


def _source_positions(plan: Plan, reduce: int) -> NDArray[np.float32] | None:
    """Positions in the file of a photo's pixels before its reduction; None if they are the file's own pixels."""
    photo, camera = plan.photo, plan.camera
    if photo.face:
        return face_positions(photo.face, *plan.size, camera.width * reduce) + 1
    if camera.model == "pinhole" and not is_pinhole(photo.intrinsics):
        return lens_positions(photo.intrinsics, plan.size, (camera.height * reduce, camera.width * reduce))
    return None


def _image(
    plan: Plan, reduce: int, background: tuple[float, float, float], positions: NDArray[np.float32] | None
) -> NDArray[np.uint8]:
    """Decode, undistort and reduce a photo."""
    image = read_photo(plan.photo.path, background, plan.upright)
    if plan.photo.face:
        image = bordered(image)
    if positions is not None:
        image = np.stack([resampled(image[..., channel], positions, 1) for channel in range(3)], axis=-1)
    if reduce > 1:
        # Explicit sums: NumPy's mean over two axes of uint8 is several times slower.
        squares = squares_of(image, plan.camera, reduce)
        total = sum(squares[:, i, :, j].astype(np.uint16) for i in range(reduce) for j in range(reduce))
        image = np.rint(total / reduce**2).astype(np.uint8)
    return image


def _mask(plan: Plan, reduce: int, positions: NDArray[np.float32] | None) -> NDArray[np.bool_] | None:
    """Decode, undistort and reduce the mask of a photo, if it has one."""
    mask = None
    if plan.photo.mask is not None:
        # Inverted before the reduction: a reduced pixel is used only if all its source pixels are.
        mask = _fitted_mask(plan.photo.mask, *plan.size, plan.upright) ^ plan.invert_mask
        if plan.photo.face:
            mask = bordered(mask)
        mask = mask if positions is None else resampled(mask, positions, 0)
        if reduce > 1:  # a pixel averaged from a masked one is masked as well
            mask = np.asarray(squares_of(mask, plan.camera, reduce).all(axis=(1, 3)))
    if plan.camera.model == "fisheye":
        seen = _image_circle(plan.camera)
        if not seen.all():
            mask = seen if mask is None else mask & seen
    return mask


def _image_circle(camera: Camera) -> NDArray[np.bool_]:
    """Compute the mask (H, W) of a fisheye's image circle. Outside it, the lens polynomial yields no angle."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.asarray(np.isfinite(camera.rays(u, v)[..., 0]))


def _fitted_mask(path: Path, width: int, height: int, upright: bool) -> NDArray[np.bool_]:
    """Read a mask as its photo is read, and resize it to the photo's size, by nearest neighbour."""
    mask = read_mask(path, upright)
    if not fits((mask.shape[1], mask.shape[0]), Intrinsics("PINHOLE", (), width, height)):
        raise InputError(
            f"{path}: expected a mask with the aspect ratio of the photo, {width}x{height} pixels, found "
            f"{mask.shape[1]}x{mask.shape[0]}"
        )
    return nearest(mask, height, width)


def nearest(pixels: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """Resize pixels (H, W) by nearest neighbour."""
    rows = ((np.arange(height) + 0.5) * pixels.shape[0] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * pixels.shape[1] / width).astype(int)
    return pixels[np.ix_(rows, columns)]
