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
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

import clsplat.device
import clsplat.selftest
from clsplat.camera import Camera
from clsplat.cli import main
from clsplat.commands.listing import describe
from clsplat.config import DataConfig, FewViewsConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.formats import FORMATS, load_gaussians, save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.testing import synthetic_scene
from clsplat.training.presets import load_preset

SIZE = (40, 32)


def read_image(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB") if image.mode != "I;16" else image)


def write_dataset(folder: Path, count: int = 9) -> Gaussians:
    """Write a transforms.json dataset with renders of known Gaussians by the twins; return the Gaussians."""
    truth = synthetic_scene(40, seed=4)[0]
    rng = np.random.default_rng(0)
    truth.means[:] = rng.uniform(-0.6, 0.6, truth.means.shape)
    truth.log_scales[:] = np.log(0.15)
    truth.logit_opacities[:] = 1.5
    truth.sh[:, 0] = rng.uniform(-1, 1.5, (40, 3))
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        eye = [3 * np.sin(angle), -1.0, 3 * np.cos(angle)]
        camera = Camera.look_at(eye, [0, 0, 0], [0, -1, 0], 45, *SIZE)
        Image.fromarray(to_uint8(render(truth, camera, device="reference").rgb)).save(folder / f"{i}.png")
        # transforms.json holds camera to world, in OpenGL axes.
        matrix = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"{i}.png", "transform_matrix": matrix.tolist()})
    intrinsics = {"fl_x": 45, "fl_y": 45, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2, "w": SIZE[0], "h": SIZE[1]}
    (folder / "transforms.json").write_text(json.dumps(intrinsics | {"frames": frames}))
    return truth


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_dataset(folder)
    return folder


def run(*arguments: object) -> None:
    main([str(a) for a in arguments])


def fails(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must fail; return its error message, a single sentence."""
    with pytest.raises(SystemExit) as exit_:
        run(*arguments)
    assert exit_.value.code == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    lines = [line for line in error.splitlines() if line.startswith("clsplat: ")]
    assert len(lines) == 1, error
    return lines[0]


TRAIN = ("--iterations", 20, "--init.random-points", 200, "--checkpoint-every", 10, "--eval-every", 10)


@pytest.fixture(scope="module")
def trained(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    run("train", dataset, "-o", out, *TRAIN)
    return out


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


def test_mesh_of_a_run(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("mesh", trained, "-o", tmp_path / "mesh.ply", "--resolution", 16)
    assert "triangles" in capsys.readouterr().err
    vertices = PlyData.read(tmp_path / "mesh.ply")["vertex"]
    run("mesh", trained, "-o", tmp_path / "part.ply", "--resolution", 24, "--box", -1, -1, -1, 1, 1, 1)
    assert len(vertices) > 10 and np.isfinite(vertices["x"]).all()
    assert "expected the suffix .ply" in fails(capsys, "mesh", trained, "-o", tmp_path / "mesh.obj")
    assert "expected six numbers" in fails(capsys, "mesh", trained, "-o", tmp_path / "b.ply", "--box", 1, 2, 3)


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
    assert seen == [replace(load_preset("paper-30k"), iterations=7000, few=FewViewsConfig(below=0))]
    assert load_preset("paper-30k").iterations != 7000
    assert "expected one of " in fails(capsys, "train", dataset, "-o", tmp_path / "b", "--preset", "nothing")
    both = ("--preset", "fast", "--config", "x.json")
    assert "expected one of them, found both" in fails(capsys, "train", dataset, "-o", tmp_path / "b", *both)
    assert not (tmp_path / "b").exists()


def test_control_c_saves_and_says_how_to_go_on(dataset: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "clsplat", "train", str(dataset), "-o", str(tmp_path), "--iterations", "100000"]
    command += ["--init.random-points", "200"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    # The log's first line is written after 10 iterations: training is under way.
    while not ((tmp_path / "log.jsonl").exists() and (tmp_path / "log.jsonl").stat().st_size):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=120)[1]
    assert process.returncode == 130
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
    train = "train", dataset, "--iterations", 3, "-o"
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


def test_devices_names_the_default_and_tests_each(capsys: pytest.CaptureFixture[str]) -> None:
    run("devices")
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("* ") for line in lines) == 2  # the device and the line that explains the star
    assert (
        sum(re.fullmatch(r"    works: all \d+ stages agree with the reference", line) is not None for line in lines)
        > 0
    )


def test_devices_stars_one_of_two_equal_entries_and_checks(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two files of one driver in the list of drivers are two entries that compare equal."""
    twice = clsplat.device.list_devices()[:1] * 2
    monkeypatch.setattr(clsplat.device, "list_devices", lambda: twice)
    monkeypatch.setattr(clsplat.selftest, "faults_of", lambda index: {"scan": "found 7"} if index else {})
    with pytest.raises(SystemExit) as ended:
        run("devices", "--check")
    out = capsys.readouterr().out
    assert ended.value.code == 1
    assert len(re.findall(r"^\* .*: ", out, re.M)) == 1
    assert out.count("works: all") == 1 and out.count("FAILS: scan: found 7") == 1
    run("devices")  # without --check, faults are only reported
    monkeypatch.setattr(clsplat.selftest, "faults_of", lambda index: {})
    run("devices", "--check")


def test_devices_shows_known_faults_and_what_a_driver_refuses(capsys: pytest.CaptureFixture[str]) -> None:
    platform = SimpleNamespace(name="rusticl")
    describe(
        SimpleNamespace(name="llvmpipe", platform=platform, version="OpenCL 3.0", driver_version="25.0.7"), False
    )
    out = capsys.readouterr().out
    assert "  rusticl: llvmpipe" in out and "0 compute units" in out
    assert "known: declares subgroups in OpenCL C 3.0 alone" in out


def test_a_run_is_not_overwritten(trained: Path, dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = fails(capsys, "train", dataset, "-o", trained, *TRAIN)
    assert "holds a run already" in message
    assert "--resume" in message


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
    from clsplat.device import Device

    check = Device._check_size
    monkeypatch.setattr(
        Device,
        "_check_size",
        lambda self, what, nbytes: check(self, what, nbytes << (50 if what == "gradients per intersection" else 0)),
    )
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
