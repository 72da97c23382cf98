"""Faults at every call: one call of a command fails, each in turn. `make faults` tries all of them."""

import errno
import os
import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
from PIL import Image

from clsplat.camera import Camera
from clsplat.dataset.sfm.triangulation import triangulate
from clsplat.errors import InputError
from clsplat.run_log import log_file
from clsplat.scene import View
from clsplat.training import run_folder
from clsplat.training.run_folder import held

if sys.platform == "win32":
    pytest.skip("needs fcntl", allow_module_level=True)

from fault_commands import COMMANDS
from measure_faults import Command, prepared

PER_KIND = {"train": 2}
"""Points of each kind of call that the default run tries; 1 for the other commands."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared(tmp_path_factory.mktemp("faults").resolve())


@pytest.mark.parametrize("name", COMMANDS)
def test_a_call_that_fails(root: Path, name: str) -> None:
    """The command ends with a sentence, every file is whole, and the next run leaves the same bits."""
    command = Command(name, root)
    found = {case: command.problems(*case) for case in command.cases(PER_KIND.get(name, 1))}
    assert {case: problems for case, problems in found.items() if problems != []} == {}
    assert len(found) >= len({point.kind for point in command.points})


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_every_call_that_fails(root: Path, name: str) -> None:
    command = Command(name, root)
    found = {case: command.problems(*case) for case in command.cases()}
    assert {case: problems for case, problems in found.items() if problems != []} == {}


def test_a_file_that_is_not_written_whole_is_found(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def in_place(path: Path) -> Iterator[BinaryIO]:
        with Path(path).open("wb") as file:
            yield file

    command = Command("export", root)
    monkeypatch.setattr("clsplat.formats.sog.replacing", in_place)
    case = next(point for point in command.points if point.kind == "write")
    found = command.problems(case._replace(about="out/scene.sog"), "ENOSPC")
    assert found and "scene.sog is not whole" in found


def test_a_log_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    append = log_file(tmp_path / "run" / "log.jsonl", 0)
    shutil.rmtree(tmp_path / "run")
    with pytest.raises(InputError, match=r"cannot write .*log\.jsonl: No such file"):
        append({"iteration": 10, "loss": 0.5})


def test_a_log_for_tensorboard_that_cannot_be_written_ends_the_run(tmp_path: Path) -> None:
    """On a thread of its own, the first error ended the thread, and the training then waited for it without end."""
    pytest.importorskip("tensorboardX")
    threads = threading.active_count()
    append = log_file(tmp_path / "log.jsonl", 0)
    assert threading.active_count() == threads
    shutil.rmtree(tmp_path / "tensorboard")
    with pytest.raises(InputError, match=r"cannot write .*tensorboard: No such file"):
        append({"iteration": 10, "loss": 0.5})
    (tmp_path / "tensorboard").write_text("")
    with pytest.raises(InputError, match=r"cannot write .*tensorboard: File exists"):
        log_file(tmp_path / "log.jsonl", 0)


def test_a_folder_that_cannot_be_signed_is_left_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path) -> None:
        raise InputError(f"cannot write {path}: No space left on device")

    monkeypatch.setattr(run_folder, "replacing", full)
    with pytest.raises(InputError, match="No space left"), held(tmp_path / "new"):
        pass
    assert list(tmp_path.iterdir()) == []


def view() -> View:
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), 40, 32, 24)
    return View("a", camera, np.zeros((24, 32, 3), np.uint8))


def test_triangulation_on_a_full_disk_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    with pytest.raises(InputError, match=r"cannot triangulate points: cannot write to .*: No space left on device"):
        triangulate([view()])


def test_triangulation_does_not_need_to_remove_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(path: object, **_: object) -> None:
        raise OSError(errno.EIO, "Input/output error", path)

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with monkeypatch.context() as patch:
        patch.setattr(os, "rmdir", refused)
        points, *_ = triangulate([view()])
    assert len(points) == 0 and list(tmp_path.iterdir()) != []
