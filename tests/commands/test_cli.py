"""The command line end to end on a tiny dataset, and one sentence for each kind of bad input."""

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import SIZE, TRAIN, fails, read_image, run
from plyfile import PlyData

from clsplat.cli import end, main
from clsplat.config import CoarseConfig, DataConfig, FewViewsConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.formats import FORMATS, load_gaussians, save_gaussians
from clsplat.training.presets import load_preset


@pytest.mark.parametrize("suffix", FORMATS)
def test_export_knows_every_format(trained: Path, tmp_path: Path, suffix: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about data that the format cannot hold
        run("export", trained / "scene.ply", "-o", tmp_path / f"a{suffix}")
        run("export", tmp_path / f"a{suffix}", "-o", tmp_path / "again.ply")
    assert len(load_gaussians(tmp_path / "again.ply")[0]) == len(load_gaussians(trained / "scene.ply")[0])


def test_train_writes_a_compact_file_beside_its_folder(dataset: Path, tmp_path: Path) -> None:
    run("train", dataset, "-o", tmp_path / "mine.spz", *TRAIN)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", "mine.spz"]
    scene, compact = (load_gaussians(path)[0] for path in (tmp_path / "mine" / "scene.ply", tmp_path / "mine.spz"))
    assert len(scene) == len(compact)
    with pytest.raises(SystemExit):  # the run is there already
        run("train", dataset, "-o", tmp_path / "mine.spz", *TRAIN)


def test_train_leaves_a_scene_and_says_how_good_it_is(trained: Path) -> None:
    names = {p.name for p in trained.iterdir()} - {"tensorboard"}  # where that is installed
    assert names == {"checkpoint.npz", "config.json", "eval", "log.jsonl", "scene.ply", "training_curve.png"}
    config = json.loads((trained / "config.json").read_text())
    assert config["iterations"] == 20
    assert config["init"]["random_points"] == 200
    records = [json.loads(line) for line in (trained / "log.jsonl").read_text().splitlines()]
    assert [r["iteration"] for r in records] == [10, 20]
    assert all(r["psnr"] > 5 and 0 < r["loss"] < 1 for r in records)
    metrics = json.loads((trained / "eval" / "metrics.json").read_text())
    # The last evaluation in the log and the report evaluate the same Gaussians.
    assert metrics["mean"]["psnr"] == pytest.approx(records[-1]["psnr"])
    assert len(metrics["views"]) == 2


def test_train_tells_what_it_learned_about_photos(dataset: Path, tmp_path: Path) -> None:
    run("train", dataset, "-o", tmp_path, *TRAIN, "--exposure", "--poses")
    photos = json.loads((tmp_path / "photos.json").read_text())
    scene = load_scene(dataset, DataConfig())
    assert list(photos) == [view.name for view in scene.train]
    for view in scene.train:
        colours, viewmat = (np.array(photos[view.name][key]) for key in ("colours", "viewmat"))
        given = view.camera.translated(-scene.offset).viewmat
        # After 20 iterations each photo has been seen three times, at rates that fall from 0.01 and 0.001.
        assert 0 < np.abs(colours - np.eye(3, 4)).max() < 0.1
        assert 0 < np.abs(viewmat - given)[:3, :3].max() < 0.01
    as_posed, aligned = (
        json.loads((tmp_path / name / "metrics.json").read_text())["mean"] for name in ("eval", "eval_aligned")
    )
    assert as_posed["psnr"] != aligned["psnr"]
    assert as_posed["psnr_fitted"] > as_posed["psnr"] - 0.1


def test_eval_of_the_saved_scene_gives_the_figures_of_training(trained: Path, dataset: Path, tmp_path: Path) -> None:
    run("eval", trained / "scene.ply", dataset, "-o", tmp_path)
    again = json.loads((tmp_path / "metrics.json").read_text())
    first = json.loads((trained / "eval" / "metrics.json").read_text())
    # Quaternions are normalised when they are saved: renders agree to rounding, which may move an 8-bit value.
    assert again["mean"]["psnr"] == pytest.approx(first["mean"]["psnr"], abs=0.01)
    assert (tmp_path / "index.html").exists()


def test_render_writes_views_and_orbits(trained: Path, dataset: Path, tmp_path: Path) -> None:
    run("render", trained / "scene.ply", dataset, "-o", tmp_path / "test", "--depth")
    assert sorted(p.name for p in (tmp_path / "test").iterdir()) == ["0.png", "0_depth.png", "8.png", "8_depth.png"]
    picture, expected = read_image(tmp_path / "test" / "8.png"), read_image(trained / "eval" / "render" / "8.png")
    assert np.abs(picture.astype(int) - expected).max() <= 1
    assert read_image(tmp_path / "test" / "8_depth.png").max() == 65535
    run("render", trained / "scene.ply", dataset, "-o", tmp_path / "surface", "--surface")
    median = read_image(tmp_path / "surface" / "8_median.png")
    normals = read_image(tmp_path / "surface" / "8_normals.png")
    assert median.max() == 65535 and normals.shape == picture.shape
    np.testing.assert_array_equal(normals.any(axis=2), median > 0)
    run("render", trained / "scene.ply", dataset, "-o", tmp_path / "orbit", "--path", "orbit", "--frames", 3)
    assert sorted(p.name for p in (tmp_path / "orbit").iterdir()) == ["0000.png", "0001.png", "0002.png"]
    assert read_image(tmp_path / "orbit" / "0000.png").shape[:2] == SIZE[::-1]


def test_render_tells_of_images_that_are_not_its_own(
    trained: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    orbit = ("render", trained / "scene.ply", dataset, "-o", tmp_path, "--path", "orbit", "--frames")
    run(*orbit, 3)
    assert "also holds" not in capsys.readouterr().err
    run(*orbit, 2)
    assert f"{tmp_path}: also holds images of other commands (0002.png)" in capsys.readouterr().err
    assert (tmp_path / "0002.png").exists()


@pytest.mark.parametrize("command", ["render", "eval"])
def test_views_that_show_nothing_are_told(
    command: str, trained: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gaussians, mode, _ = load_gaussians(trained / "scene.ply")
    gaussians.means[:] += 1000
    save_gaussians(tmp_path / "elsewhere.ply", gaussians, mode)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        run(command, tmp_path / "elsewhere.ply", dataset, "-o", tmp_path / "out")
    assert "2 of 2 views show nothing of the scene; do the cameras belong to it?" in capsys.readouterr().err


def test_each_view_is_rendered_to_files_of_its_own(trained: Path, dataset: Path, tmp_path: Path) -> None:
    """Also where names differ in the suffix alone, or in what follows a dot and is no suffix."""
    shutil.copytree(dataset, tmp_path / "data")
    meta = json.loads((dataset / "transforms.json").read_text())
    named = ["a.jpg", "a.png", "a_depth.png", "f/render.0001", "f/render.0002"]
    (tmp_path / "data" / "f").mkdir()
    for k, name in enumerate(named):
        meta["frames"][k]["file_path"] = name
        photo = tmp_path / "data" / f"{k}.png"
        photo.rename(tmp_path / "data" / (f"{name}.png" if name.startswith("f") else name))
    (tmp_path / "data" / "transforms.json").write_text(json.dumps(meta | {"test_filenames": named}))
    out = tmp_path / "out"
    run("render", trained / "scene.ply", tmp_path / "data", "-o", out, "--depth")
    stems = ["a", "a_", "a_depth_", "f/render.0001", "f/render.0002"]
    files = {path.relative_to(out).as_posix() for path in out.rglob("*.png")}
    assert files == {f"{stem}{ending}.png" for stem in stems for ending in ("", "_depth")}
    assert len({read_image(out / f"{stem}.png").tobytes() for stem in stems}) == 5


def test_mesh_of_a_run(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("mesh", trained, "-o", tmp_path / "mesh.ply", "--resolution", 16)
    assert "triangles" in capsys.readouterr().err
    vertices = PlyData.read(tmp_path / "mesh.ply")["vertex"]
    run("mesh", trained, "-o", tmp_path / "part.ply", "--resolution", 24, "--box", -1, -1, -1, 1, 1, 1)
    assert len(vertices) > 10 and np.isfinite(vertices["x"]).all()
    assert "expected the suffix .ply" in fails(capsys, "mesh", trained, "-o", tmp_path / "mesh.obj")
    assert "expected six numbers" in fails(capsys, "mesh", trained, "-o", tmp_path / "b.ply", "--box", 1, 2, 3)
    run("mesh", trained, "-o", tmp_path / "part.ply", "--resolution", 16)  # a mesh is replaced
    assert PlyData.read(tmp_path / "part.ply")["vertex"].count == len(vertices)


def test_a_mesh_does_not_replace_a_scene(
    trained: Path, dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "scene.ply"
    shutil.copyfile(trained / "scene.ply", scene)
    message = fails(capsys, "mesh", scene, dataset, "-o", scene, "--resolution", 16)
    assert "expected a new file or a mesh to replace, found a PLY without triangles" in message
    assert scene.read_bytes() == (trained / "scene.ply").read_bytes()


def test_export_keeps_the_scene(trained: Path, tmp_path: Path) -> None:
    run("export", trained / "scene.ply", "-o", tmp_path / "copy.ply")
    assert (tmp_path / "copy.ply").read_bytes() == (trained / "scene.ply").read_bytes()


def test_resume_of_a_finished_run_changes_nothing(dataset: Path, tmp_path: Path) -> None:
    run("train", dataset, "-o", tmp_path, *TRAIN)
    before = (tmp_path / "scene.ply").read_bytes()
    run("train", dataset, "-o", tmp_path, *TRAIN, "--resume")
    assert (tmp_path / "scene.ply").read_bytes() == before


def test_the_config_of_a_run_repeats_it(trained: Path, dataset: Path, tmp_path: Path) -> None:
    run("train", dataset, "-o", tmp_path / "again", "--config", trained / "config.json")
    assert (tmp_path / "again" / "scene.ply").read_bytes() == (trained / "scene.ply").read_bytes()
    assert (tmp_path / "again" / "config.json").read_text() == (trained / "config.json").read_text()


def test_flags_count_more_than_a_preset(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # 7000 is the default of TrainConfig: a flag counts even if it equals the default.
    seen: list[TrainConfig] = []
    monkeypatch.setattr("clsplat.commands.train.train_and_report", lambda scene, config, *_: seen.append(config))
    run("train", dataset, "-o", tmp_path / "a", "--preset", "paper-30k", "--iterations", 7000, "--few.below", 0)
    expected = replace(load_preset("paper-30k"), iterations=7000, few=FewViewsConfig(below=0))
    assert seen == [replace(expected, coarse=CoarseConfig(factor=1))]
    assert load_preset("paper-30k").iterations != 7000
    assert "expected one of " in fails(capsys, "train", dataset, "-o", tmp_path / "b", "--preset", "nothing")
    both = ("--preset", "fast", "--config", "x.json")
    assert "expected one of them, found both" in fails(capsys, "train", dataset, "-o", tmp_path / "b", *both)
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_training_saves_and_says_how_to_go_on(
    number: signal.Signals, status: int, dataset: Path, tmp_path: Path
) -> None:
    """By Ctrl-C, or by SIGTERM, which batch systems and containers send."""
    command = [sys.executable, "-m", "clsplat", "train", str(dataset), "-o", str(tmp_path), "--iterations", "100000"]
    command += ["--init.random-points", "200"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    # The log's first line is written after 10 iterations: training is under way.
    while not ((tmp_path / "log.jsonl").exists() and (tmp_path / "log.jsonl").stat().st_size):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    error = process.communicate(timeout=120)[1]
    assert process.returncode == status
    assert re.search(r"stopped after iteration \d+$", error, flags=re.M)
    assert f"to continue: clsplat {shlex.join(command[3:])} --resume\n" in error
    assert "Traceback" not in error
    assert (tmp_path / "checkpoint.npz").exists()


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_shells_can_complete_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["--tyro-print-completion", shell])
    script = capsys.readouterr().out
    assert not exit_.value.code
    assert all(word in script for word in ("clsplat", "train", "info", "--max-gaussians", "--invert-masks"))


def test_quiet_says_nothing_and_verbose_where_an_error_is_from(dataset: Path, tmp_path: Path) -> None:
    """In processes of their own, since tqdm reads the environment on import."""

    def said(*arguments: object) -> str:
        command = [sys.executable, "-m", "clsplat", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True).stderr

    missing = tmp_path / "no.ply"
    train = "train", dataset, "--init.no-triangulate", "--iterations", 3, "-o"
    assert re.fullmatch("training failed: .*\n", said(*train, tmp_path / "quiet", "-q")), "warnings only"
    assert (tmp_path / "quiet" / "scene.ply").is_file()
    for word in ("device: ", "3/3", "held-out photos"):
        assert word in said(*train, tmp_path / f"normal {word[:2].strip('/')}"), word
    assert said("--quiet", "info", missing).startswith(f"clsplat: {missing}")
    assert "Traceback" in said("info", missing, "--verbose")
    assert "expected one of them" in said("-q", "-v", "info", missing)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
@pytest.mark.parametrize("wanted", [True, False])
def test_no_color(wanted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Help is coloured on a terminal, unless NO_COLOR is set (no-color.org)."""
    import pty

    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("NO_COLOR", "" if wanted else "1")
    shown = bytearray()

    def read(terminal: int) -> bytes:
        shown.extend(part := os.read(terminal, 1024))
        return part

    monkeypatch.setattr(os, "write", lambda _, data: len(data))
    pty.spawn([sys.executable, "-m", "clsplat", "devices", "--help"], read)
    assert b"usage" in shown and (b"\x1b[" in shown) == wanted


def test_too_little_memory_is_a_sentence(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ends: list[object] = []

    def run_out(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 9 GiB")

    monkeypatch.setattr("clsplat.cli.atexit.register", lambda *arguments: ends.append(arguments[0]))
    monkeypatch.setattr("clsplat.training.session.Training.run_until", run_out)
    error = fails(capsys, "train", dataset, "-o", tmp_path / "out", *TRAIN)
    assert "this machine has not enough memory (Unable to allocate 9 GiB); use smaller photos" in error
    assert ends[-1] is end


RELEASING = """
from clsplat import cli

class Array:
    def __del__(self):
        print("released", flush=True)

def run(arguments):
    array = Array()
    raise MemoryError("Unable to allocate 9 GiB")

cli.run = run
cli.main([])
"""


def test_without_memory_nothing_is_released() -> None:
    """Arrays and libraries may wait for locks that the driver still holds: the process would never end."""
    ended = subprocess.run([sys.executable, "-c", RELEASING], capture_output=True, text=True)
    assert ended.returncode == 2 and "not enough memory" in ended.stderr
    assert ended.stdout == ""
