"""The folder of a run: one writer at a time, and nothing changes in it before all checks are passed."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from cli_runs import fails, run, write_dataset
from PIL import Image

from clsplat.errors import InputError
from clsplat.training.run_folder import held

QUICK = (
    *("--iterations", 12, "--init.random-points", 200, "--init.no-triangulate"),
    *("--checkpoint-every", 4, "--eval-every", 0),
)

HOLDING = """
import sys
from pathlib import Path
from clsplat.training.run_folder import held
with held(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holding(tmp_path: Path) -> Iterator[Callable[[Path], "subprocess.Popen[str]"]]:
    """Start a process that holds a folder until its input ends; returns when it does."""
    processes = []

    def start(out: Path) -> "subprocess.Popen[str]":
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        process = subprocess.Popen([sys.executable, "-c", HOLDING, str(out)], text=True, **pipes)  # type: ignore[call-overload]
        processes.append(process)
        assert process.stdout and process.stdout.readline() == "held\n"
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_held_folder_is_refused_with_its_holder(
    tmp_path: Path, holding: Callable[[Path], "subprocess.Popen[str]"]
) -> None:
    process = holding(tmp_path / "out")
    before = content(tmp_path / "out")
    since = r"\(since \d{4}-\d\d-\d\d \d\d:\d\d:\d\d[+-]\d\d:\d\d\)"
    who = rf"process {process.pid} on {re.escape(socket.gethostname())} {since}"
    with pytest.raises(InputError, match=f"out: expected .* found one that {who} holds; wait until it ends, or"):
        with held(tmp_path / "out"):
            raise AssertionError("held twice")
    assert content(tmp_path / "out") == before
    process.communicate("")  # its block ends
    with held(tmp_path / "out"):
        pass


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs a system that kills")
def test_a_folder_is_free_when_its_holder_is_killed(
    tmp_path: Path, holding: Callable[[Path], "subprocess.Popen[str]"]
) -> None:
    process = holding(tmp_path)
    part = tmp_path / f".checkpoint.npz.{'a0' * 8}.part"
    part.write_bytes(b"half")
    with pytest.raises(InputError, match=f"process {process.pid}"), held(tmp_path):
        pass
    assert part.exists(), "the holder may be writing it"
    process.kill()
    process.wait()
    assert json.loads((tmp_path / ".lock.json").read_text())["process"] == process.pid
    with held(tmp_path):
        assert json.loads((tmp_path / ".lock.json").read_text())["process"] == os.getpid()
        assert not part.exists()
    assert not list(tmp_path.iterdir())


def test_a_thread_holds_a_folder_again_and_another_one_does_not(tmp_path: Path) -> None:
    refused: list[str] = []

    def other() -> None:
        try:
            with held(tmp_path):
                refused.append("held twice")
        except InputError as error:
            refused.append(str(error))

    part = tmp_path / f".checkpoint.npz.{'a0' * 8}.part"
    with held(tmp_path):
        part.write_bytes(b"half")
        with held(tmp_path / ".." / tmp_path.name):
            assert part.exists(), "the process itself is writing it"
            thread = threading.Thread(target=other)
            thread.start()
            thread.join()
    assert len(refused) == 1 and f"process {os.getpid()}" in refused[0]


def test_a_folder_in_which_nothing_was_written_goes_again(tmp_path: Path) -> None:
    for written in (False, True):
        with pytest.raises(ZeroDivisionError), held(tmp_path / "a" / "b"):
            assert (tmp_path / "a" / "b").is_dir()
            if written:
                (tmp_path / "a" / "b" / "file").write_text("")
            raise ZeroDivisionError
        assert (tmp_path / "a").exists() == written
    with held(tmp_path / "a" / "b"):
        pass
    assert (tmp_path / "a" / "b").is_dir(), "it was there before"


def test_a_folder_that_cannot_be_locked_is_named(tmp_path: Path) -> None:
    (tmp_path / ".lock").mkdir()
    with pytest.raises(InputError, match=f"^cannot lock {re.escape(str(tmp_path))}: "), held(tmp_path):
        pass


def test_two_trainings_into_one_folder(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, long = tmp_path / "out", (*QUICK, "--iterations", 1_000_000)
    command = [sys.executable, "-m", "clsplat", "train", dataset, "-o", out, *long]
    process = subprocess.Popen([str(a) for a in command], stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr and any("first iteration" in line for line in process.stderr)
        config = (out / "config.json").read_bytes()
        message = fails(capsys, "train", dataset, "-o", out, *QUICK)
        assert f"found one that process {process.pid} on " in message
        assert (out / "config.json").read_bytes() == config
    finally:
        process.kill()
        process.communicate()


KILLED = """
import os, signal, sys
from clsplat.cli import main

replace, count = os.replace, 0
def killing(source, target):
    global count
    count += str(target).endswith("checkpoint.npz")
    if count == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)
os.replace = killing
main(sys.argv[1:])
"""


@pytest.fixture
def killed(dataset: Path, tmp_path: Path) -> Path:
    """The folder of a run that was killed while it wrote its second checkpoint."""
    out = tmp_path / "killed"
    command = [sys.executable, "-c", KILLED, "train", dataset, "-o", out, *QUICK]
    assert subprocess.run([str(a) for a in command], capture_output=True).returncode == -signal.SIGKILL
    assert [p for p in out.iterdir() if p.suffix == ".part"]
    return out


@pytest.mark.parametrize("difference", ["inverted", "deleted", "settings"])
def test_a_refused_resume_changes_nothing(
    dataset: Path, killed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], difference: str
) -> None:
    data, more = tmp_path / "other", ()
    write_dataset(data)
    if difference == "inverted":
        for path in data.glob("*.png"):
            with Image.open(path) as image:
                inverted = 255 - np.asarray(image)
            Image.fromarray(inverted).save(path)
        found = r"other pixels \(0.png, 1.png, 2.png and 6 more\)"
    elif difference == "deleted":
        meta = json.loads((data / "transforms.json").read_text())
        (data / "transforms.json").write_text(json.dumps(meta | {"frames": meta["frames"][:6]}))
        found = r"fewer photos \(6.png, 7.png, 8.png\)"
    else:
        data, more, found = dataset, ("--seed", 7), "--seed 7"
    before = {name: bytes_ for name, bytes_ in content(killed).items() if not name.endswith(".part")}
    message = fails(capsys, "train", data, "-o", killed, *QUICK, *more, "--resume")
    assert re.search(rf"checkpoint\.npz: expected the .* found {found}", message), message
    after = content(killed)
    for lock in (".lock", ".lock.json"):  # what the killed process left
        assert lock in before and lock not in after
        del before[lock]
    assert after == before


def test_a_resumed_run_leaves_what_a_whole_one_does(dataset: Path, killed: Path, tmp_path: Path) -> None:
    """To the byte, times aside; no part of the killed process is left."""
    run("train", dataset, "-o", tmp_path / "whole", *QUICK)
    run("train", dataset, "-o", killed, *QUICK, "--resume")

    def timeless(folder: Path) -> dict[str, bytes]:
        files = content(folder)
        files["log.jsonl"] = re.sub(rb'"seconds": [0-9.e-]+', b"", files["log.jsonl"])
        return {name: files[name] for name in ("log.jsonl", "config.json", "scene.ply")}

    assert timeless(killed) == timeless(tmp_path / "whole")
    names = [{p.name for p in folder.iterdir()} for folder in (killed, tmp_path / "whole")]
    assert names[0] == names[1]


def test_resume_where_there_is_no_run(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    expected = f"{out}: expected a checkpoint to resume from, found none; start the run without --resume, or name its"
    for data in (dataset, tmp_path / "missing"):  # the cheapest check comes first
        assert expected in fails(capsys, "train", data, "-o", out, *QUICK, "--resume")
    assert not out.exists()
    out.mkdir()
    (out / "config.json").write_text("{}")
    assert expected in fails(capsys, "train", dataset, "-o", out, *QUICK, "--resume")
    assert content(out) == {"config.json": b"{}"}
