"""Checkpoints: what they hold, and what is left when writing one fails."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_run import CONFIG, same

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.renderer import Renderer
from clsplat.run_log import log_file
from clsplat.scene import Scene
from clsplat.training.checkpoint import load_state, save_state, write_photos
from clsplat.training.densify import Edit
from clsplat.training.loop import train
from clsplat.training.optimizer import Optimizer
from clsplat.training.rows import without_harmonics
from clsplat.training.state import State, initial_state


def random_state(scene: Scene) -> State:
    """A state every array of which is unlike that of a fresh one."""
    state, rng = initial_state(scene, CONFIG), np.random.default_rng(0)
    for part in (state.moments.first, state.moments.second):
        for array in part.arrays().values():
            array[:] = rng.uniform(1, 2, array.shape)
    for array in state.strategy.statistics.values():
        array[:] = rng.integers(1, 9, array.shape)
    return replace(state, iteration=7, seconds=1.5)


def test_a_checkpoint_holds_everything(scene: Scene, tmp_path: Path) -> None:
    state = random_state(scene)
    save_state(tmp_path / "checkpoint.npz", state, CONFIG)
    loaded = load_state(tmp_path / "checkpoint.npz", scene.extent, CONFIG)
    assert (loaded.iteration, loaded.seconds, loaded.extent) == (7, 1.5, scene.extent)
    assert same(loaded.gaussians, state.gaussians)
    assert same(loaded.moments.first, state.moments.first)
    assert same(loaded.moments.second, state.moments.second)
    for name, array in state.strategy.statistics.items():
        np.testing.assert_array_equal(loaded.strategy.statistics[name], array)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"iteration": CONFIG.iterations + 1}, f"iteration {CONFIG.iterations + 1} of {CONFIG.iterations}"),
        ({"seconds": np.nan}, "seconds = nan"),
        ({"losses": [1.0, np.inf]}, "losses = "),
    ],
)
def test_values_that_no_run_saves_are_damage(
    scene: Scene, tmp_path: Path, changes: dict[str, Any], found: str
) -> None:
    save_state(tmp_path / "checkpoint.npz", replace(random_state(scene), **changes), CONFIG)
    with pytest.raises(InputError, match=f"found a damaged file: .*{found}"):
        load_state(tmp_path / "checkpoint.npz", scene.extent, CONFIG)


@pytest.mark.parametrize("on_device", [False, True], ids=["on the host", "on the device"])
@pytest.mark.parametrize("reset", [False, True])
def test_moments_and_harmonics_follow_an_edit(scene: Scene, device: Device, reset: bool, on_device: bool) -> None:
    before = random_state(scene).rows
    optimizer = Optimizer(Renderer(device), "device" if on_device else "numpy")
    rows, fresh = np.array([3, 1, 1]), np.array([False, False, True])
    gaussians = without_harmonics(before.gaussians).take(rows)
    gaussians.means[2] = 7
    edited = before.on(optimizer.home).after(Edit(gaussians, rows, fresh, reset_opacities=reset), optimizer)
    assert isinstance(edited.gaussians.means, np.ndarray)
    assert isinstance(edited.gaussians.sh, np.ndarray) == isinstance(edited.moments.first.means, np.ndarray)
    assert isinstance(edited.gaussians.sh, np.ndarray) == (not on_device)
    after = edited.on(optimizer.home).on(None)
    np.testing.assert_array_equal(after.gaussians.means, gaussians.means)
    np.testing.assert_array_equal(after.gaussians.sh, before.gaussians.sh[rows])
    pairs = (before.moments.first, after.moments.first), (before.moments.second, after.moments.second)
    for old, new in pairs:
        for name in ("means", "logit_opacities"):
            kept = 0 if reset and name == "logit_opacities" else getattr(old, name)[rows[:2]]
            np.testing.assert_array_equal(getattr(new, name)[:2], kept)
            assert (getattr(new, name)[2] == 0).all()


def test_a_failed_write_leaves_the_last_checkpoint(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "checkpoint.npz"
    state = initial_state(scene, CONFIG)
    save_state(path, state, CONFIG)

    def full(file: Any, **arrays: Any) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(InputError, match="No space left"):
            save_state(path, replace(state, iteration=7), CONFIG)
    loaded = load_state(path, scene.extent, CONFIG)
    assert loaded.iteration == 0
    assert same(loaded.gaussians, state.gaussians)
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.npz"]


def test_a_folder_that_cannot_be_made_is_named(scene: Scene, device: Device, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot create .*file/out: Not a directory"):
        train(scene, CONFIG, tmp_path / "file" / "out", device)


def test_names_of_photos_need_not_be_text(scene: Scene, tmp_path: Path) -> None:
    """Names of files are bytes; those that are not UTF-8 come with surrogates (PEP 383)."""
    odd = [replace(scene.train[0], name="fa\udce7ade.png"), *scene.train[1:]]
    named = replace(scene, train=odd)
    write_photos(tmp_path / "photos.json", random_state(named), named)
    assert "fa\udce7ade.png" in json.loads((tmp_path / "photos.json").read_text())


def test_the_log_is_also_written_for_tensorboard(tmp_path: Path) -> None:
    """A resumed run's first step says that what was there from it on no longer counts."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    for begin, end in ((0, 20), (10, 30)):
        append = log_file(tmp_path / "log.jsonl", begin)
        for iteration in range(begin + 10, end + 1, 10):
            append({"iteration": iteration, "loss": iteration / 100})
    found = []
    for path in sorted((tmp_path / "tensorboard").iterdir(), key=lambda p: int(p.suffix[1:])):
        content, at = path.read_bytes(), 0
        while at < len(content):  # length, its check, the event, its check
            length = int.from_bytes(content[at : at + 8], "little")
            event = event_pb2.Event.FromString(content[at + 12 : at + 12 + length])
            at += 16 + length
            found += [(value.tag, event.step, value.simple_value) for value in event.summary.value]
            found += ["start"] * (event.session_log.status == event.session_log.START)
    losses = [("loss", step, pytest.approx(step / 100)) for step in (10, 20, 20, 30)]
    assert found == [*losses[:2], "start", *losses[2:]]


def test_the_log_drops_what_a_resumed_run_repeats(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    path.write_text('{"iteration": 10}\n{"iteration": 20}\n{"iteration": 30}\n{"iter')
    log_file(path, 20)({"iteration": 30, "again": 1})
    assert [json.loads(line) for line in path.read_text().splitlines()] == [
        {"iteration": 10},
        {"iteration": 20},
        {"iteration": 30, "again": 1},
    ]
