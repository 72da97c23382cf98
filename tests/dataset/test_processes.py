"""Functions in a process of their own: results, errors, and a process that dies."""

import os
import signal
from pathlib import Path

import pytest

from clsplat.dataset.sfm.matching import demand
from clsplat.dataset.sfm.processes import apart
from clsplat.errors import ClsplatError, InputError


def double(work: Path, numbers: list[float]) -> list[float]:
    print("no answer")
    return [2 * number for number in numbers]


def refuse(work: Path) -> None:
    raise InputError("photo.png: expected a photo")


def run_out(work: Path) -> None:
    raise MemoryError("std::bad_alloc")


def fail(work: Path) -> None:
    raise RuntimeError("SQLite error: disk I/O error")


def abort(work: Path) -> None:
    os.abort()


def kill(work: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_the_result_comes_back(tmp_path: Path) -> None:
    assert apart("double", f"{__name__}:double", tmp_path, numbers=[0.1, 1e300]) == [0.2, 2e300]


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (refuse, InputError, r"^photo\.png: expected a photo$"),
        (run_out, MemoryError, r"^std::bad_alloc$"),
        (fail, ClsplatError, r"^cannot find cameras: COLMAP, .*, reports: SQLite error: disk I/O error$"),
        (
            abort,
            ClsplatError,
            "^cannot find cameras: the process of COLMAP was ended by SIGABRT; its output",
        ),
        (kill, ClsplatError, "SIGKILL; the system ends processes so where there is not enough memory"),
    ],
)
def test_its_end_is_an_error(tmp_path: Path, function, error, message) -> None:
    with pytest.raises(error, match=message):
        apart("find cameras", f"{__name__}:{function.__name__}", tmp_path)


def test_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.dataset.sfm.processes.unwritable", lambda folder: "No space left on device")
    with pytest.raises(ClsplatError, match=f"{tmp_path.parent} takes no files: No space left on device"):
        apart("find cameras", f"{__name__}:fail", tmp_path)


def test_photos_that_colmap_leaves_out_are_refused(tmp_path: Path) -> None:
    demand(tmp_path, ["a.png", "b.png"], ["b.png", "a.png"])
    with pytest.raises(InputError, match=r"cannot read .*b\.png: COLMAP could not read 1 of 2 photos"):
        demand(tmp_path, ["a.png", "b.png"], ["a.png"])
