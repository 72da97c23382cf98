"""Faults: processes killed, disks full, devices lost. What was saved last stays whole, a run resumes from it to the
same bits, and the message says so."""

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyopencl as cl
import pytest
from cli_runs import TRAIN, fails, run, write_dataset
from small_files import small_files

from clsplat.device import Device
from clsplat.errors import BuildError, DeviceError, driver_errors

KILLS = 40


@pytest.fixture(scope="module")
def whole(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The scene that a run without faults ends in."""
    out = tmp_path_factory.mktemp("whole")
    run("train", dataset, "-o", out, *TRAIN)
    return (out / "scene.ply").read_bytes()


# Saves each kind of output in a child process that dies while it writes, and compares what is there with what was.
WRITERS = """
import json, os, resource, signal, sys, warnings
from dataclasses import replace
from pathlib import Path
import numpy as np
from clsplat.training.checkpoint import save_state
from clsplat.commands.console import write_json
from clsplat.config import TrainConfig
from clsplat.errors import InputError
from clsplat.formats import FORMATS, save_gaussians
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene
from clsplat.training.loop import initial_state

warnings.simplefilter("ignore")
folder, fault = Path(sys.argv[1]), sys.argv[2]
gaussians, camera = synthetic_scene(50)
gaussians = gaussians.astype(np.float32)
view = View("a", camera, np.zeros((camera.height, camera.width, 3), np.uint8))
points = gaussians.means.astype(np.float64)
state = initial_state(Scene([view], [], points, np.zeros((50, 3), np.uint8)), TrainConfig())
savers = {f"scene{suffix}": lambda path, n: save_gaussians(path, gaussians.take(np.arange(n))) for suffix in FORMATS}
savers["checkpoint.npz"] = lambda path, n: save_state(path, replace(state, iteration=n), TrainConfig())
savers["config.json"] = lambda path, n: write_json(path, {"n": [n] * 100})
for name, save in savers.items():
    path = folder / name
    save(path, 40)
    before = path.read_bytes()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if fault == "killed before the end":
            os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
        else:  # the file may not grow beyond 64 bytes: the system kills who writes more, or refuses
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL if fault == "killed in the middle" else signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))
        try:
            save(path, 50)
        except InputError as error:
            os._exit(7 if name in str(error) else 8)
        os._exit(9)
    status = os.waitpid(child, 0)[1]
    died = os.WTERMSIG(status) if os.WIFSIGNALED(status) else -os.WEXITSTATUS(status)
    print(json.dumps({"name": name, "died": died, "same": path.read_bytes() == before,
                      "left": sorted(p.name for p in folder.iterdir() if p.name.endswith(".part"))}))
"""


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="needs a system with limits on the size of files")
@pytest.mark.parametrize(
    ("fault", "died"),
    [
        ("killed before the end", getattr(signal, "SIGKILL", 0)),
        ("killed in the middle", getattr(signal, "SIGXFSZ", 0)),
        ("disk full", -7),
    ],
)
def test_what_was_saved_last_stays_whole(tmp_path: Path, fault: str, died: int) -> None:
    """kill -9 and a full disk while any kind of output is written, by the system's own limit on the size of files."""
    script = [sys.executable, "-c", WRITERS, str(tmp_path), fault]
    done = subprocess.run(script, capture_output=True, text=True, check=True)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) > 6
    for row in rows:
        assert row["died"] == died and row["same"], row
        assert fault != "disk full" or not row["left"], row


KILLED_IN_CHECKPOINT = """
import os, signal, sys
from clsplat.cli import main

replace, count = os.replace, 0
def killing(source, target):
    global count
    if str(target).endswith("checkpoint.npz"):
        count += 1
        if count == 2:
            os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)
os.replace = killing
main(sys.argv[1:])
"""


def test_a_run_killed_while_it_writes_a_checkpoint_resumes(dataset: Path, whole: bytes, tmp_path: Path) -> None:
    arguments = ["train", dataset, "-o", tmp_path, *TRAIN]
    done = subprocess.run(
        [sys.executable, "-c", KILLED_IN_CHECKPOINT, *map(str, arguments)], capture_output=True, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert (tmp_path / "checkpoint.npz").exists() and not (tmp_path / "scene.ply").exists()
    run(*arguments, "--resume")
    assert (tmp_path / "scene.ply").read_bytes() == whole


DISK_FULL = """
import importlib, resource, sys
from clsplat.cli import main

train = importlib.import_module("clsplat.training.recorder")
save, saved = train.save_state, []
def filling(path, *arguments):
    if path in saved:  # no file grows beyond 4 kB from the second checkpoint on
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    saved.append(path)
    save(path, *arguments)
train.save_state = filling
main(sys.argv[1:])
"""


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="needs a system with limits on the size of files")
def test_a_disk_that_fills_up_in_training(dataset: Path, whole: bytes, tmp_path: Path) -> None:
    """The second checkpoint does not fit; with room again the run goes on from the first."""
    arguments = ["train", dataset, "-o", tmp_path, *TRAIN]
    script = [sys.executable, "-c", DISK_FULL, *map(str, arguments)]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "checkpoint.npz: File too large" in done.stderr
    assert (tmp_path / "checkpoint.npz").exists() and not [p for p in tmp_path.iterdir() if p.suffix == ".part"]
    run(*arguments, "--resume")
    assert (tmp_path / "scene.ply").read_bytes() == whole


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="needs a system with limits on the size of files")
def test_a_last_checkpoint_that_does_not_fit_leaves_the_scene(dataset: Path, whole: bytes, tmp_path: Path) -> None:
    arguments = ["train", dataset, "-o", tmp_path, *TRAIN]
    script = DISK_FULL.replace("4096", "500_000")  # of the files, only the checkpoint is larger
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "checkpoint.npz: File too large; the scene is written next, without it" in done.stderr
    assert (tmp_path / "scene.ply").read_bytes() == whole


@pytest.mark.parametrize("reason", ["OUT_OF_RESOURCES", "MEM_OBJECT_ALLOCATION_FAILURE", "DEVICE_NOT_AVAILABLE"])
def test_a_device_that_fails_in_the_middle(
    dataset: Path,
    whole: bytes,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    reason: str,
) -> None:
    """The kernel that Adam is part of fails in iteration 15; the checkpoint of iteration 10 goes on."""
    launch, steps = Device.launch, []

    def failing(self: Device, stage: str, kernel: str, *arguments: object, **named: object) -> None:
        steps.extend([kernel] * (kernel == "project_bwd_adam"))
        if len(steps) == 15:
            raise cl.RuntimeError(f"clEnqueueNDRangeKernel failed: {reason}")
        launch(self, stage, kernel, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(Device, "launch", failing)
    arguments = ("train", dataset, "-o", tmp_path, *TRAIN)
    message = fails(capsys, *arguments)
    assert f"iteration 15: the OpenCL driver failed: clEnqueueNDRangeKernel failed: {reason}" in message
    assert "--resume continues from it" in message and str(tmp_path) in message
    monkeypatch.undo()
    run(*arguments, "--resume")
    assert (tmp_path / "scene.ply").read_bytes() == whole


def test_a_device_that_fails_in_any_command_is_one_sentence(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run("train", dataset, "-o", tmp_path, *TRAIN)

    def failing(*arguments: object, **named: object) -> None:
        raise cl.LogicError("clEnqueueReadBuffer failed: INVALID_COMMAND_QUEUE")

    monkeypatch.setattr(Device, "launch", failing)
    message = fails(capsys, "eval", tmp_path / "scene.ply", dataset, "-o", tmp_path / "eval")
    assert message == "clsplat: the OpenCL driver failed: clEnqueueReadBuffer failed: INVALID_COMMAND_QUEUE"


def test_kernels_that_cannot_be_built_say_why(device: Device) -> None:
    with pytest.raises(cl.RuntimeError) as failed:
        cl.Program(device.context, "no kernel").build()
    with pytest.raises(BuildError, match="cannot build the kernels: clBuildProgram failed"), driver_errors():
        raise failed.value
    with small_files(), pytest.raises(BuildError, match=r"compiler writes files, and .* takes none: File too large"):
        with driver_errors():
            raise failed.value


def test_a_folder_that_takes_no_files_is_named_before_photos_are_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with small_files():
        message = fails(capsys, "train", tmp_path / "none", "-o", tmp_path / "out")
    assert message.startswith(f"clsplat: cannot write to {tmp_path / 'out'}: File too large; `ulimit -f` limits")
    assert list(tmp_path.iterdir()) == []


def test_memory_is_not_blamed_for_kernels(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(self: Device, *arguments: object, **named: object) -> None:
        cl.Program(self.context, "no kernel").build()

    monkeypatch.setattr(Device, "launch", failing)
    message = fails(capsys, "train", dataset, "-o", tmp_path, *TRAIN)
    assert "iteration 1: cannot build the kernels" in message and "--memory-limit" not in message


def test_only_the_drivers_errors_become_sentences() -> None:
    with pytest.raises(DeviceError, match="the OpenCL driver failed: RuntimeError"), driver_errors():
        raise cl.RuntimeError("")
    with pytest.raises(ZeroDivisionError), driver_errors():
        1 / 0  # noqa: B018


@pytest.mark.slow
def test_killed_at_any_moment_and_resumed(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    arguments = ["train", str(tmp_path / "data"), "--iterations", "400", "--init.random-points", "3000"]
    arguments += ["--checkpoint-every", "5", "--eval-every", "0"]

    def start(out: Path) -> subprocess.Popen[bytes]:
        resume = ["--resume"] if (out / "checkpoint.npz").exists() else []
        command = [sys.executable, "-m", "clsplat", *arguments, "-o", str(out), *resume]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    started = time.perf_counter()
    assert start(tmp_path / "whole").wait() == 0
    whole = time.perf_counter() - started

    moments = random.Random(0)
    kills = finished = 0
    while kills < KILLS:
        # A folder is resumed until its run gets through; then the next one begins.
        out = tmp_path / f"broken{finished}"
        process = start(out)
        try:
            assert process.wait(moments.uniform(0, 0.7 * whole)) == 0
            assert (out / "scene.ply").read_bytes() == (tmp_path / "whole" / "scene.ply").read_bytes()
            finished += 1
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
    out = tmp_path / f"broken{finished}"
    assert start(out).wait() == 0
    assert (out / "scene.ply").read_bytes() == (tmp_path / "whole" / "scene.ply").read_bytes()
