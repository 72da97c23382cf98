"""Processor time of features and of matches, for extrapolation to thousands of photos.

Usage: python tests/dataset/measure_matching.py FOLDER

Detects the features of the photos in a folder at the default size and matches all pairs.
"""

import resource
import sys
import tempfile
from pathlib import Path

from clsplat.config import SfmConfig
from clsplat.dataset.photos import list_photos, photo_folder
from clsplat.dataset.sfm.matching import extract, match, quiet
from clsplat.dataset.sfm.pairs import pairs_to_match


def used() -> float:
    """Processor time of this process and of those that have ended, s."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def main() -> None:
    import pycolmap

    folder, names = photo_folder(Path(sys.argv[1])), list_photos(Path(sys.argv[1]))
    with tempfile.TemporaryDirectory() as work, quiet(False):
        database = Path(work) / "database.db"
        pycolmap.Database.open(database).close()
        pycolmap.import_images(database, folder, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE)
        times = [used()]
        extract(database, folder, names, SfmConfig().max_image_size)
        times.append(used())
        with pycolmap.Database.open(database) as opened:
            pairs = pairs_to_match(opened, folder, SfmConfig(matching="exhaustive"))
            features = opened.num_keypoints() / len(names)
        match(database, pairs)
        times.append(used())
    print(
        f"{len(names)} photos, {features:.0f} features each: {(times[1] - times[0]) / len(names):.2f} s per photo, "
        f"{(times[2] - times[1]) / len(pairs):.2f} s per pair of {len(pairs)}"
    )


if __name__ == "__main__":
    main()
