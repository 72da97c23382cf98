"""Runs that were killed, interrupted or had ended go on to the same bits, from checkpoints that are whole."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
from small_run import CONFIG, EACH_STRATEGY, same, with_strategy

from clsplat.config import OptimConfig
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.scene import Scene
from clsplat.training.checkpoint import load_state, save_state
from clsplat.training.loop import train
from clsplat.training.run_length import with_length
from clsplat.training.state import initial_state


def lines(folder: Path) -> list[str]:
    """The log without times."""
    records = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [json.dumps({k: v for k, v in record.items() if k != "seconds"}) for record in records]


@EACH_STRATEGY
@pytest.mark.parametrize("killed_at", [26, 49, 51])
def test_a_killed_run_resumes_to_the_same_bits(
    scene: Scene, device: Device, tmp_path: Path, killed_at: int, strategy: str
) -> None:
    config = with_strategy(strategy)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    expected = train(scene, config, whole, device)

    class Killed(Exception):
        pass

    def kill(record: dict[str, object]) -> None:
        if record["iteration"] == killed_at:
            raise Killed

    with pytest.raises(Killed):
        train(scene, config, broken, device, progress=kill)
    first: list[object] = []
    resumed = train(scene, config, broken, device, resume=True, progress=lambda r: first.append(r["iteration"]))
    assert first[0] == 25 * (killed_at // 25) + 1
    assert same(resumed, expected)

    assert lines(broken) == lines(whole), "the mean losses too, although checkpoints lie between two lines"


def test_an_interrupted_run_loses_nothing(scene: Scene, device: Device, tmp_path: Path) -> None:
    expected = train(scene, CONFIG, tmp_path, device)

    def interrupt(record: dict[str, object]) -> None:
        if record["iteration"] == 33:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(scene, CONFIG, tmp_path, device, progress=interrupt)
    assert load_state(tmp_path / "checkpoint.npz", scene.extent, with_length(CONFIG, scene)).iteration == 33
    assert same(train(scene, CONFIG, tmp_path, device, resume=True), expected)


def test_a_run_that_has_ended_resumes_to_the_same_log(scene: Scene, device: Device, tmp_path: Path) -> None:
    """The line of its end is about the saved scene, and is written again."""
    train(scene, CONFIG, tmp_path, device)
    expected = lines(tmp_path)
    train(scene, CONFIG, tmp_path, device, resume=True)
    assert lines(tmp_path) == expected


def test_resume_refuses_what_would_not_continue(scene: Scene, device: Device, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=f"^{tmp_path}: expected a checkpoint to resume from, found none; start the run without"
    ):
        train(scene, CONFIG, tmp_path, device, resume=True)
    train(scene, CONFIG, tmp_path, device)
    with pytest.raises(
        InputError, match=r"made with, --optim\.means-lr 0\.\d+ .*, found --optim\.means-lr 1\.0 .*; repeat"
    ):
        train(scene, replace(CONFIG, optim=OptimConfig(means_lr=1.0)), tmp_path, device, resume=True)
    data = (tmp_path / "checkpoint.npz").read_bytes()
    (tmp_path / "checkpoint.npz").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"checkpoint\.npz: .* found a damaged file"):
        train(scene, CONFIG, tmp_path, device, resume=True)


@pytest.mark.parametrize("shape", ["(1000000000000, 3)", "(3, 3", "(40, 3), 'x': [" + "(" * 3000])
def test_arrays_that_lie_take_no_memory(scene: Scene, tmp_path: Path, shape: str) -> None:
    """NumPy's reader allocates what an array's header says; this one is refused before."""
    state, path = initial_state(scene, CONFIG), tmp_path / "checkpoint.npz"
    save_state(path, state, CONFIG)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(path, "w") as archive:
        for name, part in parts.items():
            archive.writestr(name, content if name == "gaussians.means.npy" else part)
    with pytest.raises(InputError, match=r"checkpoint\.npz: .* found a damaged file: an array"):
        load_state(path, scene.extent, CONFIG)
