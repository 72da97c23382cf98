"""Load a folder as a `Scene`: detect the kind of dataset, hold out photos and choose the origin."""

import os
import warnings
from collections.abc import Callable, Container
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from clsplat.config import DataConfig, SfmConfig
from clsplat.dataset import colmap, transforms
from clsplat.dataset.decoding import Dataset, PosedPhoto, by_faces, load_view, load_views
from clsplat.dataset.depth_maps import aligned, find_depth_map, load_depth_map
from clsplat.dataset.finding import PhotosMissing, mask_folder
from clsplat.dataset.near_planes import with_near_planes
from clsplat.dataset.outlines import points_of_outlines
from clsplat.dataset.photos import list_photos
from clsplat.dataset.sfm import reconstruction as sfm
from clsplat.dataset.sfm.triangulation import filled, triangulate
from clsplat.errors import InputError, named
from clsplat.ranges import FLOAT32_MAX, check
from clsplat.scene import DepthMap, Scene, View

RECOVERED, COLMAP, TRANSFORMS, PHOTOS = (
    "photos with cameras recovered by clsplat",
    "COLMAP model",
    "transforms.json",
    "photos without cameras",
)
"""Kinds of datasets."""

OFFSET_EXTENTS = 1000
"""Largest distance of the cameras from the origin, in scene extents, at which the origin is kept. Farther out, it is
moved to the cameras. At this distance float32 resolves 6e-5 extents; a coarser resolution would lose the small steps
of training."""


def load_scene(path: str | Path, config: DataConfig, verbose: bool = False, memory: int | None = None) -> Scene:
    """Load a dataset and decode its photos.

    Parameters
    ----------
    path : str or Path
        Folder of one of these kinds; the first that fits is used:

        * a COLMAP model (in ``sparse/0``, ``sparse``, ``colmap/sparse/0`` or the folder itself) and photos (in
          ``images`` or the folder itself);
        * ``transforms.json`` or ``transforms_train.json``;
        * photos alone, whose cameras are recovered by `clsplat.dataset.sfm.reconstruction` and stored in the folder.
    config : DataConfig
        Size, background, masks and split of the photos.
    verbose : bool
        Whether to show COLMAP's own messages.
    memory : int, optional
        Bytes of decoded photos in memory. If they take more, they are decoded when they are needed
        (`clsplat.streaming`). Default: half of the machine's memory.

    Returns
    -------
    Scene
        Undistorted photos, sorted by name. Every `config.test_every`-th photo is held out, unless the dataset defines
        a split. Their cameras draw nothing before the depth of their `near_plane`.

    Raises
    ------
    InputError
        If a setting is out of range, the folder holds no dataset, a file is missing or damaged, a photo has several
        cameras, a point is not finite in single precision, or no photo is left to train on; the message names the
        setting or the file.

    Warns
    -----
    UserWarning
        If some photos with a camera have no file, only some exist in the requested size, or masks are black.
    """
    check(config)
    path = Path(path)
    if not path.is_dir():
        raise InputError(
            f"{path}: expected the folder of a dataset, found {'a file' if path.exists() else 'nothing'}"
        )
    dataset = _read_dataset(path, config, verbose)
    if not (np.abs(dataset.points) <= FLOAT32_MAX).all():
        raise InputError(
            f"{path}: expected points with finite coordinates, as float32, found {np.abs(dataset.points).max():.3g}; "
            "remove such points"
        )
    if config.panoramas == "faces":
        dataset = replace(dataset, photos=by_faces(dataset.photos))
    views = sorted(load_views(dataset, config, memory), key=lambda view: view.name)
    train, test = _split(views, dataset, config.test_every)
    if not train:
        raise InputError(
            f"{path}: expected photos to train on, found only held-out ones ({len(test)}); see test_every"
        )
    train, test = _without_hidden(train, test, dataset, path)
    for part in (train, test):
        for before, view in pairwise(part):  # sorted by name
            if before.name == view.name:
                raise InputError(f"{path}: expected a camera for each photo, found several for {view.name}")
    scene = Scene(train, test, dataset.points, dataset.colors, downscale=dataset.downscale, shown=dataset.shown)
    return with_near_planes(_near_origin(scene))


def load_scene_with_points(path: str | Path, config: DataConfig, triangulate: bool = True) -> Scene:
    """Load a dataset, and triangulate points where it has poses alone, unless `triangulate` is False.

    Near planes are then those of a training with the same setting. Parameters and errors are those of `load_scene`.
    """
    scene = load_scene(path, config)
    return with_points(scene, path, config) if triangulate else scene


def load_photos(path: str | Path, config: DataConfig, names: Container[str], memory: int | None = None) -> list[View]:
    """Decode some photos of a dataset, by name, in the dataset's coordinates.

    Parameters and errors are those of `load_scene`. Names that the dataset lacks are left out.
    """
    dataset = _read_dataset(Path(path), config, verbose=False)
    photos = by_faces(dataset.photos) if config.panoramas == "faces" else dataset.photos
    chosen = [photo for photo in photos if photo.name in names]
    return load_views(replace(dataset, photos=chosen), config, memory) if chosen else []


def _without_hidden(
    train: list[View], test: list[View], dataset: Dataset, path: Path
) -> tuple[list[View], list[View]]:
    """Leave out photos with black masks: they teach nothing, and have no metrics.

    Faces of panoramas are left out without a warning: some show only what carries the camera.
    """
    faces = {photo.name for photo in dataset.photos if photo.face}
    hidden = [view.name for view in train + test if not view.is_used]
    if missed := [name for name in hidden if name not in faces]:
        warnings.warn(
            f"{path}: {len(missed)} of {len(train + test)} photos are left out, because their masks are black "
            f"({named(missed)})",
            stacklevel=3,
        )
    train, test = ([view for view in part if view.is_used] for part in (train, test))
    if not train:
        raise InputError(f"{path}: expected masks with white pixels, found black ones of all photos to train on")
    return train, test


def _split(views: list[View], dataset: Dataset, test_every: int) -> tuple[list[View], list[View]]:
    """Split views, sorted by name, into those to train on and those held out."""
    photos = {photo.name: photo for photo in dataset.photos}
    train: list[View] = []
    test: list[View] = []
    numbers: dict[str, int] = {}  # the faces of a panorama share a number, so that they are held out together
    for view in views:
        photo = photos[view.name]
        is_test = photo.held_out
        if is_test is None:
            index = numbers.setdefault(str(photo.path) if photo.face else view.name, len(numbers))
            is_test = test_every > 0 and index % test_every == 0
        (test if is_test else train).append(view)
    return train, test


def with_points(scene: Scene, path: str | Path, config: DataConfig, verbose: bool = False) -> Scene:
    """Triangulate points from the training photos, if the scene has none, and add points between them.

    Where the photos have too few features in common, the points are those of the outlines of an object before a plain
    background (`clsplat.dataset.outlines`). Near planes then follow the points. Without points, training starts from
    random ones, and nothing tells how near the scene is. The cost is measured in docs/stability.md.

    Parameters
    ----------
    scene : Scene
        As returned by `load_scene`.
    path : str or Path
        The dataset from which it was loaded. Features are detected in the photos at their full size, up to
        `clsplat.dataset.sfm.triangulation.EDGE_MAX`.
    config : DataConfig
        The options with which it was loaded.
    verbose : bool
        Whether to show COLMAP's own messages.

    Returns
    -------
    Scene
        The scene with points; still without points if the photos show neither features nor outlines.

    Raises
    ------
    InputError
        If a photo can no longer be read.
    """
    if len(scene.points):
        return scene
    dataset = _full_size(Path(path), config)
    photos = _faces_of({view.name for view in scene.train}, dataset, config)
    views = (load_view(photo, dataset, config) for photo in photos)
    moved = (replace(view, camera=view.camera.translated(scene.offset)) for view in views)
    points, colors, shown = triangulate(moved, verbose)
    points, colors = filled(points, colors) if len(points) else points_of_outlines(scene.train)
    if not len(points):
        return scene
    train, test = ([v.with_camera(replace(v.camera, near=None)) for v in part] for part in (scene.train, scene.test))
    return with_near_planes(replace(scene, train=train, test=test, points=points, colors=colors, shown=shown))


def with_depth_maps(scene: Scene, path: str | Path, config: DataConfig, tell: Callable[[str], None]) -> Scene:
    """Read the depth maps of the training photos, and scale them to the scene's points.

    Parameters
    ----------
    scene : Scene
        As returned by `load_scene`, with points.
    path : str or Path
        The dataset from which it was loaded.
    config : DataConfig
        The options with which it was loaded; `config.depth` is the folder of the maps. What masks hide is unknown.
    tell : callable
        Called with a sentence about the result.

    Raises
    ------
    InputError
        As `read_depth_maps`; if no map agrees with the points, or there are none.
    """
    return aligned(replace(scene, train=read_depth_maps(scene.train, path, config)), tell)


def read_depth_maps(views: list[View], path: str | Path, config: DataConfig) -> list[View]:
    """Read the depth maps of photos, with the values of the files.

    Parameters
    ----------
    views : list of View
        Photos of the dataset.
    path, config
        As for `with_depth_maps`.

    Raises
    ------
    InputError
        If a photo has no depth map, or one of another shape or that cannot be read; if the photos are faces of
        panoramas.
    """
    assert config.depth is not None
    path = Path(path)
    folder = mask_folder(path, config.depth, "--depth")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # load_scene has warned of missing photos
        dataset = _read_dataset(path, config, verbose=False)
    if config.panoramas == "faces" and any(p.intrinsics.model == "EQUIRECTANGULAR" for p in dataset.photos):
        raise InputError(
            "--depth: expected photos that train whole, found panoramas, which train as faces; use --panoramas whole"
        )
    photos = {photo.name: photo for photo in dataset.photos}
    files = {view.name: find_depth_map(folder, view.name) for view in views}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        maps = pool.map(lambda name: load_depth_map(files[name], photos[name], dataset), files)
        return [
            view.with_depth(_where_used(depth, view) if photos[view.name].mask else depth)
            for view, depth in zip(views, maps, strict=True)
        ]


def _where_used(depth: DepthMap, view: View) -> DepthMap:
    """A depth map that knows nothing of the pixels that a photo's mask hides."""
    return replace(depth, values=np.where(view.counts, depth.values, np.float32(np.nan)))


def _full_size(path: Path, config: DataConfig) -> Dataset:
    """Read the dataset with photos of full size; with the size of `config` if only smaller copies exist."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # load_scene has warned of missing photos
        try:
            return _read_dataset(path, replace(config, downscale=1), verbose=False)
        except InputError:
            return _read_dataset(path, config, verbose=False)


def _faces_of(names: set[str], dataset: Dataset, config: DataConfig) -> list[PosedPhoto]:
    """Choose the photos of these names, sorted by name; of panoramas their faces, from which points are made."""
    if config.panoramas == "faces":
        chosen = [photo for photo in by_faces(dataset.photos) if photo.name in names]
    else:
        chosen = by_faces([photo for photo in dataset.photos if photo.name in names])
    return sorted(chosen, key=lambda photo: photo.name)


def detect(path: Path, config: DataConfig) -> tuple[str, Dataset | None]:
    """Find out of which kind a dataset is, and read it if it comes with cameras.

    Returns
    -------
    str
        `RECOVERED`, `COLMAP`, `TRANSFORMS` or `PHOTOS`.
    Dataset or None
        The content of the kinds `COLMAP` and `TRANSFORMS`.

    Raises
    ------
    PhotosMissing
        If none of their photos is found.
    InputError
        If a file is missing or damaged; the message names it.
    """
    if sfm.read_record(path) is not None:
        return RECOVERED, None
    model, has_transforms = colmap.find_model(path), bool(transforms.find_transforms(path))
    if model is not None:
        try:
            return COLMAP, colmap.read_dataset(path, model, config)
        except PhotosMissing:
            if not has_transforms:
                raise
    return (TRANSFORMS, transforms.read_dataset(path, config)) if has_transforms else (PHOTOS, None)


def _read_dataset(path: Path, config: DataConfig, verbose: bool) -> Dataset:
    """Read a dataset of any kind; recover the cameras if it has none."""
    kind, dataset = detect(path, config)
    if dataset is not None:
        return dataset
    if kind == PHOTOS and not list_photos(path):
        raise InputError(
            f"{path}: expected a COLMAP model (sparse/0), a transforms.json or photos (here or in images), found none"
        )
    photos, options, record = path, config.sfm, sfm.read_record(path)
    if record is not None:
        photos = sfm.recorded_photos(path, record)
        # Cameras that were recovered with other options are kept, unless options are given now.
        options = options if options != SfmConfig() else SfmConfig(**record["options"])
    model = sfm.reconstruct(photos, options, path, verbose)
    return colmap.read_dataset(path, model, config, photos)


def _near_origin(scene: Scene) -> Scene:
    """Move the origin of the scene to its cameras, if they are too far from it for float32."""
    views = scene.train + scene.test
    centre = np.mean([view.camera.position for view in views], axis=0)
    if np.linalg.norm(centre) <= OFFSET_EXTENTS * scene.extent:
        return scene

    def moved(part: list[View]) -> list[View]:
        return [view.with_camera(view.camera.translated(centre)) for view in part]

    train, test = moved(scene.train), moved(scene.test)
    return replace(scene, train=train, test=test, points=scene.points - centre, offset=centre)
