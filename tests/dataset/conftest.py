"""Fixtures of structure from motion: photos of a corner, their model, a copy of it, and a count of runs."""

import shutil

import pytest
from PIL import Image
from test_transforms import write_photos
from textured_corner import CONFIG, take_photos

from clsplat.dataset.sfm import reconstruction as sfm
from clsplat.dataset.sfm.reconstruction import reconstruct


@pytest.fixture(scope="session")
def photos():
    """The photos of the four cameras, as arrays."""
    return take_photos(0)


@pytest.fixture(scope="session")
def solved(photos, tmp_path_factory):
    """Folder of the photos with their model; tests must not change it."""
    folder = tmp_path_factory.mktemp("solved")
    for k, photo in enumerate(photos):
        Image.fromarray(photo).save(folder / f"photo {k}.png")
    assert reconstruct(folder, CONFIG) == folder / "sparse" / "0"
    return folder


@pytest.fixture
def copy(solved, tmp_path):
    """Copy of `solved` that a test may change."""
    return shutil.copytree(solved, tmp_path / "copy")


@pytest.fixture
def runs(solved, monkeypatch):
    """Replace the mapping by the model of `solved`, and count the calls."""
    asked = []

    def found(work, folder, names, config, verbose):
        asked.append(names)
        shutil.copytree(solved / "sparse" / "0", work / "sparse" / "0")
        return 4

    monkeypatch.setattr(sfm, "_solved", found)
    return asked


@pytest.fixture
def root(tmp_path):
    """A folder with four photos."""
    write_photos(tmp_path)
    return tmp_path
