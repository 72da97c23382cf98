"""Matching in processes: the result depends neither on their number nor on other readers of the database."""

import shutil
import subprocess
import sys

import pycolmap
import pytest
from PIL import Image
from test_reconstruction import take_photos

from clsplat.dataset.sfm import matching as features
from clsplat.dataset.sfm.matching import COUNT_ROWS, extract, match
from clsplat.dataset.sfm.processes import EXIT_WITH_PARENT
from clsplat.errors import ClsplatError

READER = """
import sqlite3, sys, time
reader = sqlite3.connect(sys.argv[1], uri=True)
reader.execute("SELECT COUNT(*) FROM images").fetchone()
print(flush=True)
time.sleep(600)
"""


@pytest.fixture(scope="module")
def extracted(tmp_path_factory):
    """Database with the features of four photos, and all pairs of them; tests must not change it."""
    folder = tmp_path_factory.mktemp("extracted")
    names = [f"photo {k}.png" for k in range(4)]
    for name, photo in zip(names, take_photos(0), strict=True):
        Image.fromarray(photo).save(folder / name)
    database = folder / "database.db"
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, folder, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE)
    extract(database, folder, names, 1000)
    with pycolmap.Database.open(database) as opened:
        numbers = sorted(image.image_id for image in opened.read_all_images())
    return database, [(i, j) for i in numbers for j in numbers if i < j]


@pytest.fixture
def database(extracted, tmp_path):
    """Copy of the database that a test may change."""
    return shutil.copyfile(extracted[0], tmp_path / "database.db")


def contents(database):
    """Pairs, their matches, and the matches that remain after verification."""
    with pycolmap.Database.open(database) as opened:
        numbers, matches = opened.read_all_matches()
        verified, geometries = opened.read_two_view_geometries()
        names = {image.name for image in opened.read_all_images()}
    assert sorted(numbers) == sorted(verified)
    found = {n: [matches[numbers.index(n)], geometries[verified.index(n)]] for n in sorted(numbers)}
    return names, {n: (m.tolist(), g.config, g.inlier_matches.tolist(), g.F.tolist()) for n, (m, g) in found.items()}


def test_the_number_of_processes_changes_nothing(extracted, tmp_path, monkeypatch):
    pairs, results = extracted[1], []
    monkeypatch.setattr(features, "PAIRS_MIN", 1)
    for count in (1, 2, 4):
        monkeypatch.setattr(features.os, "cpu_count", lambda count=count: count)
        copy = shutil.copyfile(extracted[0], tmp_path / f"{count}.db")
        match(copy, pairs)
        results.append(contents(copy))
        assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == []
    names, found = results[0]
    assert names == {f"photo {k}.png" for k in range(4)} and len(found) == 6
    assert all(len(inliers) > 100 for _, _, inliers, _ in found.values())
    assert results[1:] == results[:1] * 2


def test_features_count_that_are_still_in_the_log(extracted, tmp_path):
    """A process that reads while features are written prevents SQLite from merging its log into the file."""
    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    uri = f"{database.as_uri()}?mode=ro"
    with subprocess.Popen([sys.executable, "-c", READER, uri], stdout=subprocess.PIPE) as reader:
        reader.stdout.readline()
        pycolmap.import_images(database, extracted[0].parent, camera_mode=pycolmap.CameraMode.SINGLE)
        extract(database, extracted[0].parent, [f"photo {k}.png" for k in range(4)], 1000)
        reader.kill()
    assert (tmp_path / "database.db-wal").stat().st_size > 1_000_000
    match(database, extracted[1])
    _, found = contents(database)
    assert len(found) == 6 and all(len(matches) > 100 for matches, *_ in found.values())


def test_no_pairs_match_nothing(database):
    match(database, [])
    assert contents(database)[1] == {}


def test_a_process_that_fails_is_an_error_and_ends_the_others(extracted, database, monkeypatch):
    monkeypatch.setattr(features, "PAIRS_MIN", 3)
    monkeypatch.setattr(features.os, "cpu_count", lambda: 2)
    fails_first = "import signal, sys\nif not sys.argv[2].endswith('0.db'): signal.pause()\nsys.exit(7)"
    monkeypatch.setattr(features, "MATCH_SHARE", fails_first)
    with pytest.raises(ClsplatError, match="status 7"):
        match(database, extracted[1])
    assert contents(database)[1] == {} and sorted(path.name for path in database.parent.iterdir()) == ["database.db"]


@pytest.mark.parametrize("program", [COUNT_ROWS, "print(flush=True)\nsignal.pause()"], ids=["count rows", "other"])
def test_a_process_ends_with_the_one_that_started_it(program, tmp_path):
    """The end of the parent closes the pipe, whatever ended it; the database may be gone by then."""
    (tmp_path / "a.db").touch()
    command = [
        sys.executable,
        "-I",
        "-c",
        EXIT_WITH_PARENT + program,
        "images",
        f"{(tmp_path / 'a.db').as_uri()}?mode=ro",
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as child:
        child.stdin.close()
        assert child.wait(timeout=300) == 1
