"""What the command line refuses, in one sentence, and what it leaves behind."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runs import TRAIN, fails, run, write_dataset

from clsplat.formats import load_gaussians, save_gaussians


def test_a_run_is_not_overwritten(trained: Path, dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = fails(capsys, "train", dataset, "-o", trained, *TRAIN)
    assert "holds a run already" in message
    assert "--resume" in message


@pytest.mark.parametrize("left", ["scene.ply", "field.npz"])
def test_a_result_without_its_checkpoint_is_not_overwritten(
    left: str, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / left).write_bytes(b"trained for days")
    message = fails(capsys, "train", dataset, "-o", tmp_path, *TRAIN)
    assert f"{tmp_path}: expected a folder without {left}, found one" in message
    assert (tmp_path / left).read_bytes() == b"trained for days"


def test_a_file_beside_the_folder_is_not_overwritten(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "old.spz").write_bytes(b"trained for days")
    message = fails(capsys, "train", dataset, "-o", tmp_path / "old.spz", *TRAIN)
    assert "old.spz: expected a new file, found one that exists" in message
    assert [path.name for path in tmp_path.iterdir()] == ["old.spz"]


def test_a_run_that_ended_before_its_first_checkpoint_starts_again(
    trained: Path, dataset: Path, tmp_path: Path
) -> None:
    for name in ("config.json", "log.jsonl"):
        shutil.copyfile(trained / name, tmp_path / name)
    run("train", dataset, "-o", tmp_path, *TRAIN)
    assert (tmp_path / "scene.ply").read_bytes() == (trained / "scene.ply").read_bytes()


def test_train_says_what_memory_it_takes_and_when_it_has_begun(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("train", dataset, "-o", tmp_path / "out", *TRAIN, "--iterations", 2, "--memory-limit", "20MB")
    said = capsys.readouterr().err
    assert re.search(r"^memory: \d\.\d MB for 200 Gaussians, .* limit 20\.0 MB, enough for \d{4,5}$", said, re.M)
    assert len(re.findall(r"^\r?.*first iteration: done \d+\.\d s after the start", said, re.M)) == 1


def test_memory_limits_that_cannot_be_kept(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ("train", dataset, "-o", tmp_path / "out", *TRAIN, "--memory-limit")
    assert "expected a size such as 4GB" in fails(capsys, *command, "12")
    message = fails(capsys, *command, "0.3MB")
    assert re.search(r"expected at least \d\.\d MB for 200 Gaussians at 40x32, .* size: \d+ Gaussians", message)
    assert not (tmp_path / "out").exists()


def test_bad_folders(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert "missing" in fails(capsys, "train", tmp_path / "missing", "-o", out)
    (tmp_path / "empty").mkdir()
    assert "empty" in fails(capsys, "train", tmp_path / "empty", "-o", out)
    assert not out.exists()
    (tmp_path / "file").write_text("not a folder")
    assert "cannot create" in fails(capsys, "train", dataset, "-o", tmp_path / "file" / "below", *TRAIN)


def test_bad_photos_and_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_dataset(tmp_path / "data", 3)
    (tmp_path / "data" / "1.png").write_bytes((tmp_path / "data" / "1.png").read_bytes()[:100])
    assert "1.png" in fails(capsys, "train", tmp_path / "data", "-o", tmp_path / "out", *TRAIN)
    write_dataset(tmp_path / "data", 3)
    path = tmp_path / "data" / "transforms.json"
    transforms = json.loads(path.read_text())
    transforms["frames"][2]["transform_matrix"][0][3] = float("nan")
    path.write_text(json.dumps(transforms))
    assert "2.png" in fails(capsys, "train", tmp_path / "data", "-o", tmp_path / "out", *TRAIN)
    path.write_text("{")
    assert "transforms.json" in fails(capsys, "train", tmp_path / "data", "-o", tmp_path / "out", *TRAIN)


def test_bad_scenes(trained: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = (trained / "scene.ply").read_bytes()
    bad = tmp_path / "bad.ply"
    bad.write_bytes(whole.replace(b"property float opacity\n", b"property float opaqueness\n"))
    assert "opacity" in fails(capsys, "eval", bad, dataset, "-o", tmp_path / "out")
    bad.write_bytes(whole[:-100])
    assert "bad.ply" in fails(capsys, "export", bad, "-o", tmp_path / "out.ply")
    assert "suffix" in fails(capsys, "export", trained / "scene.ply", "-o", tmp_path / "out.obj")
    assert not (tmp_path / "out.ply").exists()


def test_the_folder_of_photos_without_cameras_takes_no_run(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = shutil.copytree(dataset, tmp_path / "photos", ignore=shutil.ignore_patterns("transforms.json"))
    before = sorted(photos.iterdir())
    message = fails(capsys, "train", photos, "-o", photos, *TRAIN)
    assert "expected a folder apart from the photos" in message and message.endswith(f"use -o {photos / 'run'}")
    inside = tmp_path / "all" / "images" / "run"
    shutil.copytree(photos, inside.parent)
    assert "expected a folder apart from the photos" in fails(capsys, "train", tmp_path / "all", "-o", inside, *TRAIN)
    assert sorted(photos.iterdir()) == before and not inside.exists()


def test_a_folder_is_no_scene(
    trained: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = "expected a file of Gaussians, such as scene.ply, found a folder"
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copyfile(trained / "scene.ply", alone / "scene.ply")
    message = fails(capsys, "eval", alone, dataset, "-o", tmp_path / "eval")
    assert message == f"clsplat: {alone}: {expected}; the scene in it is {alone / 'scene.ply'}"
    original = tmp_path / "run" / "point_cloud" / "iteration_7000"
    original.mkdir(parents=True)
    shutil.copyfile(trained / "scene.ply", original / "point_cloud.ply")
    message = fails(capsys, "eval", tmp_path / "run", dataset, "-o", tmp_path / "eval")
    assert message.endswith(f"the scene in it is {original / 'point_cloud.ply'}")
    assert fails(capsys, "eval", dataset, dataset, "-o", tmp_path / "eval").endswith(expected)
    missing = tmp_path / "missing"
    message = fails(capsys, "export", missing, tmp_path / "x.spz")
    assert message == f"clsplat: {missing}: expected a file of Gaussians or the folder of a run, found nothing"


def test_unknown_device_lists_the_known(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = fails(capsys, "train", dataset, "-o", tmp_path / "out", "--device", "no such device")
    assert "no such device" in message
    assert "expected part of one of these names" in message


def test_without_a_driver_it_says_how_to_get_one(tmp_path: Path) -> None:
    # In a process of its own, since the loader reads the list of drivers once.
    script = (
        "import sys, pyopencl\npyopencl.get_platforms = lambda: []\nfrom clsplat.cli import main\nmain(['devices'])"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 2
    assert "pip install 'clsplat[pocl]'" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_buffer_beyond_the_device_is_named(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from clsplat.buffers import Buffers

    empty = Buffers.empty

    def larger(self: Buffers, what: str, shape: tuple[int, ...], dtype: Any) -> Any:
        return empty(
            self, what, (shape[0] << 50, *shape[1:]) if what == "gradients per intersection" else shape, dtype
        )

    monkeypatch.setattr(Buffers, "empty", larger)
    message = fails(capsys, "train", dataset, "-o", tmp_path / "out", *TRAIN)
    assert "gradients per intersection: needs a buffer of" in message
    assert "MiB" in message


def test_a_full_disk_leaves_nothing_half_written(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "copy.ply"
    gaussians, mode, offset = load_gaussians(trained / "scene.ply")
    save_gaussians(target, gaussians.take(np.arange(5)), mode, offset)
    before = target.read_bytes()
    original = Path.open

    class Full:
        """A file on a disk with room for 100 bytes."""

        def __init__(self, file: object):
            self.file, self.room = file, 100

        def write(self, data: bytes) -> int:
            self.room -= len(data)
            if self.room < 0:
                raise OSError(28, "No space left on device")
            return self.file.write(data)  # type: ignore[attr-defined]

        def __enter__(self) -> "Full":
            return self

        def __exit__(self, *_: object) -> None:
            self.file.close()  # type: ignore[attr-defined]

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

    monkeypatch.setattr(
        Path,
        "open",
        lambda self, mode="r", **kw: Full(original(self, mode, **kw)) if "w" in mode else original(self, mode, **kw),
    )
    message = fails(capsys, "export", trained / "scene.ply", "-o", target)
    assert "No space left" in message
    assert "copy.ply" in message
    monkeypatch.undo()
    assert target.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["copy.ply"]


@pytest.mark.parametrize(
    "flags",
    [
        ("--response",),
        ("--print-jobs",),
        ("--blocks", 2, "--exposure"),
        ("--blocks", 2, "--filter-3d"),
        ("--blocks", 2, "--viewer"),
    ],
)
def test_flags_that_exclude_each_other_are_refused_at_once(
    flags: tuple[object, ...], dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert "expected " in fails(capsys, "train", dataset, "-o", out, *TRAIN, *flags)
    assert not out.exists()
