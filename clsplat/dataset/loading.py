"""From a folder to a `Scene`: what kind of dataset it is, which photos are held out, where the origin lies."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.config import DataConfig, SfmConfig
from clsplat.constants import NEAR
from clsplat.dataset import colmap, transforms
from clsplat.dataset.decoding import Dataset, by_faces, load_view, load_views
from clsplat.dataset.finding import PhotosMissing
from clsplat.dataset.photos import list_photos
from clsplat.dataset.sfm import reconstruction as sfm
from clsplat.dataset.sfm.triangulation import filled, triangulate
from clsplat.errors import InputError
from clsplat.scene import Scene, View

OFFSET_EXTENTS = 1000
"""Scene extents that the cameras may lie from the origin before it is moved to them. There float32 still tells apart
6e-5 extents; farther out positions would lose what training moves them by."""

NEAR_SHARE = 0.1
"""Of the depth of a scene's nearest points, before which nothing is drawn. In the scenes of the original, whose near
plane is at 0.2, that is about as much; castle_p30 gains 4 dB (docs/stability.md)."""

NEAR_QUANTILE = 0.01
"""Of the depths of the points that a photo shows: the nearest of all may be a wrong one."""

NEAR_POINTS = 10_000
"""So many points are enough to find that out."""


def load_scene(path: str | Path, config: DataConfig, verbose: bool = False) -> Scene:
    """Load a dataset with its photos.

    Parameters
    ----------
    path : str or Path
        A folder with a COLMAP model (in ``sparse/0``, ``sparse``, ``colmap/sparse/0`` or itself) and photos (in
        ``images`` or itself); or with ``transforms.json`` or ``transforms_train.json``; or with photos alone, whose
        cameras are then recovered by `clsplat.dataset.sfm.reconstruction` and kept there. The first of these that
        fits counts.
    config : DataConfig
        Which photos are read, and how.
    verbose : bool
        Show COLMAP's own messages.

    Returns
    -------
    Scene
        Photos undistorted, sorted by name; every `config.test_every`-th held out unless the dataset says which.
        Their cameras draw nothing before the `near_plane`.

    Raises
    ------
    InputError
        If nothing usable is found, a file is missing or damaged, or no photo is left to train on; the message names
        the file.

    Warns
    -----
    UserWarning
        If some of the photos with a camera have no file, or only some exist in the size asked for.
    """
    path = Path(path)
    if not path.is_dir():
        raise InputError(f"{path}: expected a dataset's folder, found {'a file' if path.exists() else 'nothing'}")
    if config.downscale not in (1, 2, 4, 8):
        raise InputError(f"downscale: expected 1, 2, 4 or 8, found {config.downscale}")
    if config.test_every < 0:
        raise InputError(f"test_every: expected 0 or more, found {config.test_every}")
    dataset = _find(path, config, verbose)
    dataset = replace(dataset, photos=by_faces(dataset.photos))
    photos = {photo.name: photo for photo in dataset.photos}
    views = sorted(load_views(dataset, config), key=lambda view: view.name)
    train: list[View] = []
    test: list[View] = []
    numbers: dict[str, int] = {}  # the faces of a panorama have one number: they are held out together
    for view in views:
        photo = photos[view.name]
        is_test = photo.held_out
        if is_test is None:
            index = numbers.setdefault(str(photo.path) if photo.face else view.name, len(numbers))
            is_test = config.test_every > 0 and index % config.test_every == 0
        (test if is_test else train).append(view)
    if not train:
        raise InputError(
            f"{path}: expected photos to train on, found only held-out ones ({len(test)}); see test_every"
        )
    return _with_near_planes(_near_origin(Scene(train, test, dataset.points, dataset.colors)))


def with_points(scene: Scene, path: str | Path, config: DataConfig, verbose: bool = False) -> Scene:
    """The scene with points triangulated from the photos to train on, where it has none, and filled up.

    Training would start from random points, which cost 3 to 7 dB in short runs (docs/stability.md).

    Parameters
    ----------
    scene : Scene
        From `load_scene`.
    path : str or Path
        The dataset that it was loaded from: features come from the photos as large as they are there, up to
        `clsplat.dataset.sfm.triangulation.EDGE_MAX`.
    config : DataConfig
        That it was loaded with.
    verbose : bool
        Show COLMAP's own messages.

    Returns
    -------
    Scene
        Without points as before where the photos show too few.

    Raises
    ------
    InputError
        If a photo can no longer be read.
    """
    if len(scene.points):
        return scene
    cameras = {view.name for view in scene.train}
    dataset = _full_size(Path(path), config)
    photos = sorted((photo for photo in dataset.photos if photo.name in cameras), key=lambda photo: photo.name)
    views = (load_view(photo, dataset, config) for photo in photos)
    moved = (replace(view, camera=view.camera.translated(scene.offset)) for view in views)
    points, colors = triangulate(moved, verbose)
    if len(points):
        points, colors = filled(points, colors)
    return replace(scene, points=points, colors=colors)


def _full_size(path: Path, config: DataConfig) -> Dataset:
    """The dataset with its photos' own size; that of `config` where only smaller copies are here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is missing has been told
        try:
            dataset = _find(path, replace(config, downscale=1), verbose=False)
        except InputError:
            dataset = _find(path, config, verbose=False)
    return replace(dataset, photos=by_faces(dataset.photos))


def _find(path: Path, config: DataConfig, verbose: bool) -> Dataset:
    record = sfm.read_record(path)
    model = colmap.find_model(path)
    has_transforms = bool(transforms.find_transforms(path))
    if record is None and model is not None:
        try:
            return colmap.read_dataset(path, model, config)
        except PhotosMissing:
            if not has_transforms:
                raise
    if record is None and has_transforms:
        return transforms.read_dataset(path, config)
    if record is None and not list_photos(path):
        raise InputError(
            f"{path}: expected a COLMAP model (sparse/0), a transforms.json or photos (here or in images), found none"
        )
    photos, options = path, config.sfm
    if record is not None:
        photos = path / record["photos"]
        # Nobody who recovered the cameras with options of their own wants them redone with the defaults.
        options = options if options != SfmConfig() else SfmConfig(**record["options"])
    model = sfm.reconstruct(photos, options, path, verbose)
    return colmap.read_dataset(path, model, config, photos)


def _near_origin(scene: Scene) -> Scene:
    """The scene with its cameras around the origin, if they were too far from it for float32."""
    views = scene.train + scene.test
    centre = np.mean([view.camera.position for view in views], axis=0)
    if np.linalg.norm(centre) <= OFFSET_EXTENTS * scene.extent:
        return scene

    def moved(part: list[View]) -> list[View]:
        return [replace(view, camera=view.camera.translated(centre)) for view in part]

    return Scene(moved(scene.train), moved(scene.test), scene.points - centre, scene.colors, centre)


def near_plane(scene: Scene) -> float:
    """A depth in world units before which the scene's points say that there is nothing.

    Gaussians that a camera nearly touches, of a wall beside the photographer for example, spread over its whole
    image: the photo next to it needs them, this one does not know them, and a held-out one is spoilt.

    Returns
    -------
    float
        `NEAR_SHARE` of the depth of the nearest points, by the training photo that comes nearest to them; `NEAR`
        where no photo shows points enough.
    """
    points = scene.points[:: max(1, len(scene.points) // NEAR_POINTS)]
    nearest = np.inf
    for camera in (view.camera for view in scene.train):
        points_camera = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        x, y, depths = points_camera[points_camera[:, 2] > 0].T
        u, v = camera.fx * x / depths + camera.cx, camera.fy * y / depths + camera.cy
        seen = depths[(u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)]
        if len(seen) * NEAR_QUANTILE >= 1:  # of fewer it would be the nearest point, which may be a wrong one
            nearest = min(nearest, float(np.quantile(seen, NEAR_QUANTILE)))
    return NEAR_SHARE * nearest if np.isfinite(nearest) else NEAR


def _with_near_planes(scene: Scene) -> Scene:
    near = near_plane(scene)

    def told(part: list[View]) -> list[View]:
        return [replace(view, camera=replace(view.camera, near=near)) for view in part]

    return replace(scene, train=told(scene.train), test=told(scene.test))
