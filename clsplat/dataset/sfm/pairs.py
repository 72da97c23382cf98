"""Pairs of photos that are matched: all, neighbours by name or by GPS position, or those that look alike."""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import SfmConfig
from clsplat.dataset.photos import gps_position
from clsplat.errors import InputError

GPS_NEIGHBOURS = 50
"""Photos with which each photo is matched by position: those that are nearest on the ground, as many as COLMAP's
default. A survey whose photos overlap by 80 % along a line and 70 % between lines shows a point in about 15 photos.
There is no limit of their distance: one that fits a drone's survey excludes all photos of an aeroplane's."""


def pairs_to_match(database: Any, folder: Path, config: SfmConfig) -> list[tuple[int, int]]:
    """Choose the pairs of photos to match.

    Parameters
    ----------
    database : pycolmap.Database
        Open, with the features of all photos.
    folder : Path
        The photos.
    config : SfmConfig
        Its `matching` is not "auto".

    Returns
    -------
    list of (int, int)
        Numbers of images in the database.

    Raises
    ------
    InputError
        If no photo has a GPS position in its EXIF data, or the vocabulary tree is missing or cannot be read.
    """
    import pycolmap

    if config.vocabulary is not None and config.matching != "vocabulary":
        raise InputError(
            f"--sfm.vocabulary: expected with --sfm.matching vocabulary, found {config.matching}; leave out one"
        )
    if config.matching == "exhaustive":
        return list(pycolmap.ExhaustivePairGenerator(pycolmap.ExhaustivePairingOptions(), database).all_pairs())
    if config.matching == "sequential":
        return list(pycolmap.SequentialPairGenerator(pycolmap.SequentialPairingOptions(), database).all_pairs())
    return _gps_pairs(database, folder) if config.matching == "gps" else _similar_pairs(database, config)


def _gps_pairs(database: Any, folder: Path) -> list[tuple[int, int]]:
    """Pairs of neighbours on the ground. Photos without a position are matched with all others.

    Not COLMAP's spatial pairs: it reads no position from PNG and HEIF files, nor one without an altitude.
    """
    images = sorted(database.read_all_images(), key=lambda image: image.image_id)
    positions = {image.image_id: gps_position(folder / image.name) for image in images}
    known = {number: position for number, position in positions.items() if position is not None}
    if not known:
        raise InputError(
            "--sfm.matching gps: expected photos with GPS positions in their EXIF data, found none in "
            f"{len(images)} photos; use the original files, or --sfm.matching exhaustive"
        )
    others = [pair for pair in combinations(positions, 2) if not known.keys() >= set(pair)]
    return sorted(_near([*known], np.radians([*known.values()]), GPS_NEIGHBOURS) + others)


def _near(numbers: list[int], angles: NDArray[np.float64], count: int) -> list[tuple[int, int]]:
    """Pairs (ascending) of photos of which one is among the `count` nearest of the other, each once.

    angles: latitudes and longitudes (P, 2), radians. The Earth's flattening changes distances by 0.3 % at most.
    """
    from scipy.spatial import KDTree

    latitude, longitude = angles.T
    circle = np.cos(latitude)
    points = np.stack([circle * np.cos(longitude), circle * np.sin(longitude), np.sin(latitude)], axis=1)
    # Of photos at one place, the photo itself may not be the first that is found.
    _, found = KDTree(points).query(points, k=min(count + 1, len(points)))
    found = np.reshape(found, (len(points), -1))
    return _each_once([(numbers[i], numbers[k]) for i, row in enumerate(found.tolist()) for k in row])


def _similar_pairs(database: Any, config: SfmConfig) -> list[tuple[int, int]]:
    """Pairs of photos that share visual words: Nister and Stewenius 2006, doi:10.1109/CVPR.2006.264."""
    import pycolmap

    if config.vocabulary is None:
        raise InputError(
            "--sfm.matching vocabulary: expected --sfm.vocabulary FILE, COLMAP's tree of visual words for SIFT, "
            "found none; its download page is in docs/howto/large.md"
        )
    path = Path(config.vocabulary)
    if not path.is_file():
        raise InputError(f"--sfm.vocabulary: expected a file, found none at {path}")
    try:
        pycolmap.VisualIndex.read(path)
    except (RuntimeError, ValueError) as error:
        old = "; COLMAP's vocab_tree_upgrader converts trees from before May 2025" if "legacy" in str(error) else ""
        raise InputError(f"cannot read {path}, a vocabulary tree of COLMAP 3.12 or later{old}") from error
    options = pycolmap.VocabTreePairingOptions(vocab_tree_path=path)
    return _each_once(pycolmap.VocabTreePairGenerator(options, database).all_pairs())


def _each_once(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Pairs of different photos, each once: generators list neighbours from both sides, and a photo with itself."""
    return sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})
