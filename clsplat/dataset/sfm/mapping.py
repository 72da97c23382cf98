"""Poses and points from matched photos, by COLMAP's two mappers through pycolmap.

Both run on one thread: with several, the bits differ from run to run. Incremental mapping: Schoenberger and Frahm
2016, doi:10.1109/CVPR.2016.445. Global mapping: Pan et al. 2024, "Global structure-from-motion revisited".
"""

from pathlib import Path
from typing import Any

from clsplat.dataset.sfm.matching import SEED


def map_globally(database: Path, folder: Path, out: Path, count: int, fewest: int) -> dict[int, Any]:
    """Make models whose poses are found all at once. Parameters and result are those of `map_incrementally`."""
    import pycolmap

    options = pycolmap.GlobalPipelineOptions(min_model_size=fewest, random_seed=SEED, num_threads=1)
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    pycolmap.set_random_seed(SEED)
    models: dict[int, Any] = pycolmap.global_mapping(database, folder, out, options)
    return models


def map_incrementally(database: Path, folder: Path, out: Path, count: int, fewest: int) -> dict[int, Any]:
    """Make models to which photos are added one after the other.

    Parameters
    ----------
    database : Path
        COLMAP database with verified matches.
    folder : Path
        Folder of the photos.
    out : Path
        Empty folder, to which COLMAP writes the models.
    count : int
        Number of photos, for the progress bar.
    fewest : int
        Fewest photos of a model.

    Returns
    -------
    dict
        Models by number; COLMAP starts another one with photos that do not fit the first.
    """
    import pycolmap
    from tqdm import tqdm

    options = pycolmap.IncrementalPipelineOptions(min_model_size=fewest, random_seed=SEED, num_threads=1)
    with tqdm(total=count, desc="poses", unit="photo", dynamic_ncols=True) as bar:
        # Called for each model.
        def start() -> None:
            bar.n = 2
            bar.refresh()

        pycolmap.set_random_seed(SEED)
        models: dict[int, Any] = pycolmap.incremental_mapping(
            database,
            folder,
            out,
            options=options,
            initial_image_pair_callback=start,
            next_image_callback=bar.update,
        )
        bar.n = max((model.num_reg_images() for model in models.values()), default=0)
    return models
