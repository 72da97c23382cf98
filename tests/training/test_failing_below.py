"""Faults below Python, at chosen calls: `make faults-below` tries calls of each kind. Linux only."""

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from failing_below import Fault, Point, environment, library
from PIL import Image
from textured_corner import take_photos

SFM = ("sfm", "photos", "-o", "out", "--camera-model", "SIMPLE_RADIAL")
DATABASE = "out/.clsplat_sfm_*/database.db"
FULL = Fault(errno.ENOSPC, lasting=True)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = library(tmp_path_factory.mktemp("library"))
    if path is None:
        pytest.skip("needs Linux and the compiler cc")
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder with small photos of a corner."""
    root = tmp_path.resolve() / "root"
    for folder in ("photos", "tmp"):
        (root / folder).mkdir(parents=True)
    for k, photo in enumerate(take_photos(0)):
        Image.fromarray(photo).reduce(2).save(root / "photos" / f"photo {k}.png")
    return root


def ended(root: Path, built: Path, arguments: tuple[str, ...], point: Point, fault: Fault) -> tuple[int, str]:
    """Status and messages of a command, one of whose calls fails."""
    scratch = root.with_name("scratch")
    scratch.mkdir(exist_ok=True)
    variables = environment(root, scratch, point, fault) | {"LD_PRELOAD": str(built)}
    del variables["POCL_CACHE_DIR"]  # that of all tests, which has the kernels
    process = subprocess.run(
        [sys.executable, "-m", "clsplat", *arguments],
        cwd=root,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert (scratch / "state").exists(), f"the call was not reached: {process.stderr}"
    return process.returncode, process.stderr


@pytest.mark.parametrize(
    ("point", "fault", "message"),
    [
        # COLMAP aborted its process, and photos that it could not read were missing in the model.
        (Point("write", f"{DATABASE}-wal", 20, "child"), FULL, "cannot recover the cameras: .*No space left"),
        (Point("open", "photos/photo 1.png", 1, "child"), Fault(errno.EACCES), r"photo 1\.png: COLMAP .* 1 of 4"),
        (Point("open", "photos/photo 1.png", 3, "child"), Fault(errno.EACCES), r"photo 1\.png: COLMAP .* 1 of 4"),
        # A traceback of the process that matches photos.
        (Point("create", "out/.clsplat_sfm_*/matches_*/?.db-wal", 1, "child"), FULL, "cannot match photos"),
    ],
)
def test_structure_from_motion_ends_with_a_sentence(
    root: Path, built: Path, point: Point, fault: Fault, message: str
) -> None:
    status, said = ended(root, built, SFM, point, fault)
    assert status == 2, said
    (sentence,) = re.findall("^clsplat: .*", said, re.MULTILINE)
    assert re.search(message, sentence)
    assert "Traceback" not in said and "stack trace" not in said
    assert [path.name for path in (root / "out").rglob("*")] == []
