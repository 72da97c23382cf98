"""Every reader reads or refuses every file of the corpus, and some changes of it. Each found-* file once failed.

`make fuzz` draws many more cases, guided by coverage (`fuzz_readers`).
"""

import io
import json
import random
import zipfile

import numpy as np
import pytest
from mutations import mutated
from readers import CORPUS, READERS, attempt

from clsplat.ranges import shown

CHANGES = 12
"""Changed files of each reader in the default tests."""

FILES = [(reader, path.name) for reader in READERS for path in sorted((CORPUS / reader).iterdir())]

READ = {
    "ply/found-scales-overflow",  # `clsplat info` overflowed in the histogram of its sizes
    "colmap-bin/found-distortion-subnormal",  # a quotient of a fisheye's coefficients overflowed
    "glb/found-unused-attribute",  # `clsplat info` looked up an attribute that is not read
    "photo/found-exif",  # tags that Pillow reads but cannot write, when the photo was copied upright
    "recovered/found-frames-endless",  # COLMAP did not return; frames and rigs are not read any more
    "recovered/found-rigs-missing",  # COLMAP's own IndexError
    # Both `clsplat info`, which refuses these, and the resumed run, which drops their damaged lines.
    *(f"run/found-{name}" for name in ("iteration-list", "log-latin-1", "log-list", "log-nested", "config-nested")),
    *(f"run/found-{name}" for name in ("psnr-text", "seconds-huge", "seconds-text")),
}
"""Found cases that are read; the others are refused."""

CHECKPOINTS = {
    "exposures.values": lambda a: a[:-1],
    "exposures.steps": lambda a: -1 - a,
    "poses.values": lambda a: a[..., :3],
    "poses.names": lambda a: np.array(["x", "y"]),
    "pixels": lambda a: a[:-1],
    "gaussians.means": lambda a: a * np.nan,
    "first.sh": lambda a: a + np.inf,
    "losses": lambda a: a * np.nan,
    "iteration": lambda a: a + 0.5,
    "seconds": lambda a: a - np.inf,
    "small_side.gaussians.quats": lambda a: a * np.nan,
}
"""Changes of arrays in a checkpoint that were once read, and ended in a traceback or in another scene later."""

SEARCHES = {
    "candidate of text": {"degrees": [["x", "4", 1, 20.5, [20.0], 0.1]]},
    "trial without views": {"trials": [[True, [2, 4, 1, 20.5, [], 0.1], [2, 4, 1, 20.5, [20.0, 21.0], 0.1]]]},
    "pace of zero": {"pace": 0.0},
    "number as text": {"most": "8"},
    "growth as text": {"grows": "no"},
    "validated as text": {"validated": "xy"},
}
"""The same for values of the search in it."""


def test_every_reader_has_a_small_corpus():
    assert {path.name for path in CORPUS.iterdir()} == READERS.keys()
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < 2**19


@pytest.mark.parametrize(("reader", "name"), FILES)
def test_files_of_the_corpus(tmp_path, cases, reader, name):
    cases["corpus"] += 1
    expected = "refused" if name.startswith("found-") and f"{reader}/{name}" not in READ else "read"
    assert attempt(tmp_path, reader, (CORPUS / reader / name).read_bytes()) == expected


@pytest.mark.parametrize("reader", READERS)
def test_changed_files(tmp_path, cases, reader):
    """The same changes in each run."""
    rng = random.Random(reader)
    whole = [path.read_bytes() for path in sorted((CORPUS / reader).iterdir()) if not path.name.startswith("found-")]
    for _ in range(CHANGES):
        cases["changes of the corpus"] += 1
        attempt(tmp_path, reader, mutated(rng.choice(whole), rng))


def checkpoint_with(name, change):
    """A checkpoint in which one array is changed."""
    file = io.BytesIO()
    with zipfile.ZipFile(CORPUS / "checkpoint" / "search") as old, zipfile.ZipFile(file, "w") as new:
        for info in old.infolist():
            content = old.read(info)
            if info.filename == f"{name}.npy":
                array = io.BytesIO()
                np.save(array, change(np.load(io.BytesIO(content))))
                content = array.getvalue()
            new.writestr(info, content)
    return file.getvalue()


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_checkpoints_with_a_part_that_does_not_fit_are_refused(tmp_path, name):
    assert attempt(tmp_path, "checkpoint", checkpoint_with(name, CHECKPOINTS[name])) == "refused"


@pytest.mark.parametrize("name", SEARCHES)
def test_checkpoints_with_a_damaged_search_are_refused(tmp_path, name):
    content = checkpoint_with("search", lambda a: np.array(json.dumps(json.loads(str(a)) | SEARCHES[name])))
    assert attempt(tmp_path, "checkpoint", content) == "refused"


def test_a_checkpoint_without_the_photos_parameters_is_refused(tmp_path):
    """It was read, and the run went on without them."""
    file = io.BytesIO()
    with zipfile.ZipFile(CORPUS / "checkpoint" / "start") as old, zipfile.ZipFile(file, "w") as new:
        for info in old.infolist():
            if not info.filename.startswith("exposures."):
                new.writestr(info, old.read(info))
    assert attempt(tmp_path, "checkpoint", file.getvalue()) == "refused"


def test_values_in_messages_are_short_however_large_they_are():
    """Aliases in YAML double a value with each line; text of the whole would take all memory."""
    value = ["x"]
    for _ in range(60):
        value = [value, value]
    assert len(shown(value)) <= 60
    assert shown("text") == "'text'" and shown(0.5) == "0.5" and shown([1, "a"]) == "[1, 'a']"
