"""Pairs of photos to match, by GPS positions in EXIF data and by a vocabulary tree."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image
from textured_corner import CONFIG, take_photos

from clsplat.config import SfmConfig
from clsplat.dataset.sfm import pairs
from clsplat.dataset.sfm.matching import extract, quiet
from clsplat.dataset.sfm.pairs import pairs_to_match
from clsplat.dataset.sfm.reconstruction import reconstruct
from clsplat.errors import InputError

GPS = SfmConfig(matching="gps")


def position(seconds, south=False):
    """EXIF data of a photo on the meridian of Munich."""
    exif = Image.Exif()
    exif[ExifTags.IFD.GPSInfo] = {
        ExifTags.GPS.GPSLatitudeRef: "S" if south else "N",
        ExifTags.GPS.GPSLatitude: (48.0, 8.0, seconds),
        ExifTags.GPS.GPSLongitudeRef: "E",
        ExifTags.GPS.GPSLongitude: (11.0, 34.0, 0.0),
    }
    return exif


@pytest.fixture
def imported(tmp_path):
    """Write small photos with the EXIF data given, and import them into a database."""

    def make(*exifs):
        names = [f"{k}.jpg" for k in range(len(exifs))]
        for name, exif in zip(names, exifs, strict=True):
            Image.new("RGB", (32, 24)).save(tmp_path / name, exif=exif or Image.Exif())
        database = tmp_path / "database.db"
        pycolmap.Database.open(database).close()
        pycolmap.import_images(database, tmp_path, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE)
        return pycolmap.Database.open(database)

    return make


@pytest.fixture
def folder(tmp_path):
    return tmp_path


def test_neighbours_on_the_ground_are_matched_each_once(imported, folder, monkeypatch):
    """Photos on a line, in another order than their names; the nearest two of each, itself included."""
    monkeypatch.setattr(pairs, "GPS_NEIGHBOURS", 1)
    with imported(*map(position, (0.0, 30.0, 1.0, 31.0, 2.1))) as database, quiet(False):
        found = pairs_to_match(database, folder, GPS)
    assert found == [(1, 3), (2, 4), (3, 5)]


def test_neighbours_may_be_far_away_and_south_of_the_equator_is_elsewhere(imported, folder, monkeypatch):
    monkeypatch.setattr(pairs, "GPS_NEIGHBOURS", 1)
    exifs = [position(0.0), position(50.0), position(0.0, south=True), position(50.0, south=True)]
    with imported(*exifs) as database, quiet(False):
        assert pairs_to_match(database, folder, GPS) == [(1, 2), (3, 4)], "1.5 km apart"


def test_few_photos_are_matched_exhaustively(imported, folder):
    with imported(*map(position, range(5))) as database, quiet(False):
        assert pairs_to_match(database, folder, GPS) == list(combinations(range(1, 6), 2))


def test_photos_without_a_position_are_matched_with_all(imported, folder, monkeypatch):
    monkeypatch.setattr(pairs, "GPS_NEIGHBOURS", 1)
    unknown = []
    for latitude in ((0.0, 0.0, 0.0), (99.0, 0.0, 0.0), (48.0, 8.0)):
        exif = Image.Exif()
        exif[ExifTags.IFD.GPSInfo] = {1: "N", 2: latitude, 3: "E", 4: (0.0, 0.0, 0.0)}
        unknown.append(exif)
    for missing in (None, *unknown):
        with (
            imported(position(0.0), position(1.0), position(40.0), position(41.0), missing) as database,
            quiet(False),
        ):
            assert set(pairs_to_match(database, folder, GPS)) == {(1, 2), (3, 4), (1, 5), (2, 5), (3, 5), (4, 5)}
        (folder / "database.db").unlink()


def test_no_gps_data_is_an_error_that_says_so(imported, folder):
    with imported(None, None, None) as database, quiet(False):
        message = "expected photos with GPS positions in their EXIF data, found none in 3 photos; use the original"
        with pytest.raises(InputError, match=message):
            pairs_to_match(database, folder, GPS)


def test_cameras_are_recovered_by_gps_neighbours_of_turned_photos(tmp_path):
    """Photos that are copied upright keep their positions."""
    for k, photo in enumerate(take_photos(0)):
        exif = position(float(k))
        exif[ExifTags.Base.Orientation] = 6
        Image.fromarray(np.rot90(photo)).save(tmp_path / f"{k}.jpg", exif=exif, quality=95)
    model = reconstruct(tmp_path, SfmConfig(**{**vars(CONFIG), "matching": "gps"}))
    assert pycolmap.Reconstruction(model).num_reg_images() == 4


# ---- vocabulary


@pytest.fixture(scope="module")
def described(tmp_path_factory):
    """A database of four photos, and a tree of 64 words made from their own descriptors."""
    folder = tmp_path_factory.mktemp("described")
    names = [f"{k}.png" for k in range(4)]
    for name, photo in zip(names, take_photos(0), strict=True):
        Image.fromarray(photo).save(folder / name)
    database = folder / "database.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, folder, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE)
    with quiet(False):
        extract(database, folder, names, 1000)
        with pycolmap.Database.open(database) as opened:
            found = [opened.read_descriptors(image.image_id) for image in opened.read_all_images()]
        data = np.concatenate([part.data for part in found]).astype(np.float32)
        index = pycolmap.VisualIndex.create(128, 64)
        words = pycolmap.VisualIndex.BuildOptions(num_visual_words=64, num_iterations=5, num_rounds=1)
        index.build(words, pycolmap.FeatureDescriptorsFloat(type=found[0].type, data=data))
        index.write(folder / "tree.bin")
    return database, folder / "tree.bin"


def test_a_vocabulary_tree_finds_photos_that_look_alike(described):
    database, tree = described
    with pycolmap.Database.open(database) as opened, quiet(False):
        found = pairs_to_match(opened, Path(), SfmConfig(matching="vocabulary", vocabulary=str(tree)))
    assert found == list(combinations(range(1, 5), 2)), "all show the same corner"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "expected a file, found none at"),
        (b"", "cannot read .*tree.bin, a vocabulary tree of COLMAP 3.12 or later; COLMAP's vocab_tree_upgrader"),
        (9000, r"cannot read .*tree\.bin, a vocabulary tree of COLMAP 3\.12 or later$"),
    ],
)
def test_a_tree_that_cannot_be_read_is_named(described, tmp_path, content, message):
    database, tree = described
    path = tmp_path / "tree.bin"
    if content is not None:
        path.write_bytes(tree.read_bytes()[:content] if isinstance(content, int) else content)
    with pycolmap.Database.open(database) as opened, pytest.raises(InputError, match=message):
        pairs_to_match(opened, Path(), SfmConfig(matching="vocabulary", vocabulary=str(path)))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (SfmConfig(matching="vocabulary"), "expected --sfm.vocabulary FILE"),
        (SfmConfig(matching="gps", vocabulary="a.bin"), "expected with --sfm.matching vocabulary, found gps"),
    ],
)
def test_a_tree_belongs_to_its_matching(described, config, message):
    with pycolmap.Database.open(described[0]) as opened, pytest.raises(InputError, match=message):
        pairs_to_match(opened, Path(), config)
