"""From photos to the largest model that COLMAP finds of them; `clsplat.dataset.sfm.processes.apart` runs it."""

from pathlib import Path
from typing import Any

import numpy as np

from clsplat.config import SfmConfig

# This also imports Pillow before pycolmap; see clsplat.dataset.sfm.reconstruction.
from clsplat.dataset.photos import photo_size
from clsplat.dataset.sfm.mapping import map_globally, map_incrementally
from clsplat.dataset.sfm.matching import demand, extract, match, quiet
from clsplat.dataset.sfm.pairs import pairs_to_match


def solve(work: Path, folder: str, names: list[str], options: dict[str, Any], verbose: bool) -> int:
    """Detect features, match them, run the mapper, and write the largest model to ``sparse/0`` in `work`.

    Parameters
    ----------
    work : Path
        Folder for temporary files and the model.
    folder : str
        Folder of the photos.
    names : list of str
        Their names.
    options : dict
        Fields of the `SfmConfig`; its `matching` and `mapper` are not "auto".
    verbose : bool
        Whether to show COLMAP's own messages.

    Returns
    -------
    int
        Number of photos with a pose; 0, and no model is written, if no pair of photos can start one.
    """
    with quiet(verbose):
        found = _largest_model(Path(folder), names, work, SfmConfig(**options), verbose)
        if found is None:
            return 0
        _turn_upright(found)
        (work / "sparse" / "0").mkdir(parents=True)
        found.write_binary(work / "sparse" / "0")
        return int(found.num_reg_images())


def _largest_model(folder: Path, names: list[str], work: Path, config: SfmConfig, verbose: bool) -> Any:
    """Detect features, match them and run the mapper; None if no pair of photos can start a model."""
    import pycolmap

    database = work / "database.db"
    pycolmap.Database.open(database).close()

    by_size: dict[tuple[int, int], list[str]] = {}
    for name in names:
        by_size.setdefault(photo_size(folder / name), []).append(name)
    reader = pycolmap.ImageReaderOptions(camera_model=config.camera_model)
    mode = pycolmap.CameraMode.SINGLE if config.single_camera else pycolmap.CameraMode.PER_IMAGE
    for group in by_size.values():  # COLMAP's single camera has one size, and it skips photos of another
        pycolmap.import_images(database, folder, image_names=group, camera_mode=mode, options=reader)
    with pycolmap.Database.open(database) as opened:
        demand(folder, names, [image.name for image in opened.read_all_images()])
    extract(database, folder, names, config.max_image_size)
    with pycolmap.Database.open(database) as opened:
        pairs = pairs_to_match(opened, folder, config)
    match(database, pairs, verbose)
    (work / "models").mkdir()
    mapped = map_globally if config.mapper == "global" else map_incrementally
    models = mapped(database, folder, work / "models", len(names), config.min_registered)
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _turn_upright(model: Any) -> None:
    """Rotate the world of a model so that its y axis is the mean downward direction of the photos.

    Viewers take -y as up. COLMAP's world has the axes of the first photo, which may be tilted.
    """
    import pycolmap
    from scipy.spatial.transform import Rotation

    down = np.mean([image.cam_from_world().rotation.matrix()[1] for image in model.images.values()], axis=0)
    if np.linalg.norm(down) > 0.1:  # otherwise upright and upside-down photos cancel: no common direction
        rotation, _ = Rotation.align_vectors([[0.0, 1.0, 0.0]], [down / np.linalg.norm(down)])
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation.as_matrix()), np.zeros(3)))
