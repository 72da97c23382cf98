"""From a folder to a `Scene`: what kind of dataset it is, which photos are held out, where the origin lies."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat import sfm
from clsplat.config import DataConfig, SfmConfig
from clsplat.errors import InputError
from clsplat.io import colmap, transforms
from clsplat.io.images import Dataset, PhotosMissing, by_faces, load_views
from clsplat.photos import list_photos
from clsplat.scene import Scene, View

OFFSET_EXTENTS = 1000
"""Scene extents that the cameras may lie from the origin before it is moved to them. There float32 still tells apart
6e-5 extents; farther out positions would lose what training moves them by."""


def load_scene(path: str | Path, config: DataConfig, verbose: bool = False) -> Scene:
    """Load a dataset with its photos.

    Parameters
    ----------
    path : str or Path
        A folder with a COLMAP model (in ``sparse/0``, ``sparse``, ``colmap/sparse/0`` or itself) and photos (in
        ``images`` or itself); or with ``transforms.json`` or ``transforms_train.json``; or with photos alone, whose
        cameras are then recovered by `clsplat.sfm.reconstruct` and kept there. The first of these that fits counts.
    config : DataConfig
        Which photos are read, and how.
    verbose : bool
        Show COLMAP's own messages.

    Returns
    -------
    Scene
        Photos undistorted, sorted by name; every `config.test_every`-th held out unless the dataset says which.

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
    return _near_origin(Scene(train, test, dataset.points, dataset.colors))


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
