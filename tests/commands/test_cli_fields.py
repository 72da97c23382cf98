"""`clsplat train --method` and `clsplat bench quality --methods` with radiance fields, on a tiny dataset."""

import json
import os
import shutil
import signal

import numpy as np
import pytest
from cli_runs import fails, read_image, run
from PIL import Image
from small_fields import SmallIngp
from test_info import info

from clsplat.bench.measures import sample_iterations
from clsplat.bench.results import read_records
from clsplat.commands.run_folders import read_run
from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.errors import InputError
from clsplat.fields import METHODS
from clsplat.fields.field_files import load_field
from clsplat.metrics import to_uint8


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setitem(METHODS, SmallIngp.name, SmallIngp)
    monkeypatch.setattr("clsplat.fields.space.STEP", 3**0.5 / 64)


def train(dataset, out, *flags):
    run("train", dataset, "-o", out, "--method", "ingp-base", "--iterations", 4, *flags)


def test_train_leaves_a_field_and_its_evaluation(dataset, tmp_path, device):
    train(dataset, tmp_path, "--eval-every", 2)
    field = load_field(tmp_path / "field.npz", METHODS, device)
    assert field.iteration == 4 and field.space.contracted
    metrics = json.loads((tmp_path / "eval" / "metrics.json").read_text())
    assert metrics["method"] == "ingp-base" and len(metrics["views"]) == 2
    assert metrics["model_bytes"] == (tmp_path / "field.npz").stat().st_size
    assert "ingp-base" in (tmp_path / "eval" / "index.html").read_text()
    picture = read_image(tmp_path / "eval" / metrics["views"][0]["render"])
    camera = load_scene(dataset, DataConfig()).test[0].camera
    np.testing.assert_array_equal(picture, to_uint8(field.image(camera, (0.0, 0.0, 0.0))))
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(r["iteration"], "psnr" in r) for r in log] == [(2, True), (4, False)]


def test_a_run_is_not_overwritten_but_resumes(dataset, tmp_path, capsys):
    train(dataset, tmp_path)
    before = (tmp_path / "field.npz").read_bytes()
    assert "holds a run already" in fails(capsys, "train", dataset, "-o", tmp_path, "--method", "ingp-base")
    train(dataset, tmp_path, "--resume")
    assert (tmp_path / "field.npz").read_bytes() == before


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_field_after_a_step(number, status, dataset, tmp_path, monkeypatch, capsys, device):
    """With a checkpoint from which it resumes to the same bits."""
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    train(dataset, whole)
    evaluated, sent = SmallIngp._evaluate, []

    def send_once(self, *arguments):
        if self.iteration == 2 and not sent:
            sent.append(number)
            os.kill(os.getpid(), number)
        return evaluated(self, *arguments)

    monkeypatch.setattr(SmallIngp, "_evaluate", send_once)
    with pytest.raises(SystemExit) as exit_:
        train(dataset, stopped)
    assert exit_.value.code == status
    assert f"{stopped}: stopped after iteration 2\n" in capsys.readouterr().err
    train(dataset, stopped, "--resume")
    assert (stopped / "field.npz").read_bytes() == (whole / "field.npz").read_bytes()


def test_info_tells_the_method_and_what_was_found(dataset, tmp_path, capsys):
    train(dataset, tmp_path, "--eval-every", 2, "--seed", 3)
    found, _ = info(tmp_path, capsys)
    assert found["what"] == "a run of clsplat train --method ingp-base" and found["dataset"] == str(dataset)
    assert found["iterations"] == "4 of 4" and found["settings"] == "--seed 3 --eval-every 2"
    assert found["field.npz"].endswith(" kB") and "held-out PSNR" in found and "Gaussians" not in found
    (tmp_path / "field.npz").unlink()
    assert "--resume" in info(tmp_path, capsys)[0]["field.npz"]


def test_commands_for_gaussians_say_that_a_run_has_none(dataset, tmp_path, capsys):
    train(dataset, tmp_path)
    message = f"clsplat: {tmp_path}: expected a run of Gaussians, found one of the radiance field ingp-base"
    for command in (["export", tmp_path, tmp_path / "a.spz"], ["eval", tmp_path], ["render", tmp_path]):
        assert fails(capsys, *command).startswith(message)


def test_its_configuration_trains_the_same_field(dataset, tmp_path, capsys):
    first, again = tmp_path / "first", tmp_path / "again"
    train(dataset, first, "--seed", 3)
    run("train", dataset, "-o", again, "--config", first / "config.json")
    for name in ("config.json", "field.npz"):
        assert (again / name).read_bytes() == (first / name).read_bytes()
    # Flags override the file, and Gaussians do not train with the settings of a field unless told to.
    flags = ["train", dataset, "-o", tmp_path / "other", "--config", first / "config.json"]
    assert "expected no settings of Gaussians" in fails(capsys, *flags, "--poses")
    run(*flags, "--method", "gaussians", "--iterations", 1, "--init.random-points", 50, "--eval-every", 0)
    assert (tmp_path / "other" / "scene.ply").is_file()
    bench = ["bench", "quality", dataset, "-o", tmp_path / "bench", "--methods", first / "config.json"]
    assert f"{first / 'config.json'}: method: expected settings of Gaussians" in fails(capsys, *bench)
    settings = json.loads((first / "config.json").read_text())
    (tmp_path / "damaged.json").write_text(json.dumps(settings | {"method": "nerd"}))
    damaged = fails(capsys, "train", dataset, "-o", tmp_path / "new", "--config", tmp_path / "damaged.json")
    assert f"{tmp_path / 'damaged.json'}: method: expected one of gaussians, nerf" in damaged


def test_a_run_resumes_with_its_own_method(dataset, trained, tmp_path, capsys):
    train(dataset, tmp_path)
    message = "clsplat: --method: expected {}, with which the run in {} began, found {}"
    assert fails(capsys, "train", dataset, "-o", tmp_path, "--resume") == (
        message.format("ingp-base", tmp_path, "gaussians")
    )
    assert fails(capsys, "train", dataset, "-o", trained, "--resume", "--method", "nerf") == (
        message.format("gaussians", trained, "nerf")
    )


def test_a_field_trains_on_the_frames_of_a_video(dataset, tmp_path, monkeypatch, capsys):
    def extract_frames(video, folder):
        shutil.copytree(dataset, folder, dirs_exist_ok=True)
        return 9

    monkeypatch.setattr("clsplat.dataset.video.extract_frames", extract_frames)
    video = tmp_path / "film.mp4"
    video.touch()
    train(video, tmp_path / "run")
    assert f"{tmp_path / 'run' / 'frames'}: 9 frames of film.mp4" in capsys.readouterr().err
    assert (tmp_path / "run" / "field.npz").is_file()
    assert read_run(tmp_path / "run").data == tmp_path / "run" / "frames"
    train(video, tmp_path / "run", "--resume")


def test_the_limit_of_memory_holds_for_the_photos(dataset, tmp_path, capsys, monkeypatch):
    """Nine photos of 40x32; with enough memory for eight of them."""
    enough = 8 * 3 * 40 * 32
    flags = ["train", dataset, "-o", tmp_path / "run", "--method", "ingp-base"]
    assert "clsplat: --memory-limit: expected at least 0.0 MB for the photos, as a field trains on all pixels" in (
        fails(capsys, *flags, "--memory-limit", f"{enough / 1e6}MB")
    )
    monkeypatch.setattr("clsplat.streaming.physical_memory", lambda: 2 * enough)
    assert f"clsplat: {dataset}: expected photos that fit 0.0 MB, half of this machine" in fails(capsys, *flags)


@pytest.mark.parametrize("flags", [(), ("--verbose",)])
def test_verbose_shows_the_messages_of_colmap(flags, dataset, tmp_path, capsys, monkeypatch):
    """As it does for Gaussians: `load_scene` is told."""

    def load_scene(*arguments, **_):
        raise InputError(f"verbose: {arguments[2]}")

    monkeypatch.setattr("clsplat.dataset.load_scene", load_scene)
    monkeypatch.setattr("clsplat.commands.console.loudness", "normal")  # both are changed by the flag
    monkeypatch.setenv("PYOPENCL_COMPILER_OUTPUT", "")
    flags = ("train", dataset, "-o", tmp_path / "run", "--method", "ingp-base", *flags)
    with pytest.raises(SystemExit):
        run(*flags)
    assert f"clsplat: verbose: {'--verbose' in flags}\n" in capsys.readouterr().err


def test_masks_count_in_the_memory_of_photos(dataset, tmp_path, capsys, monkeypatch):
    """A byte for a pixel, and four for the place of each that counts."""
    masks = tmp_path / "masks"
    masks.mkdir()
    for photo in dataset.glob("*.png"):
        Image.new("L", (40, 32), 255).save(masks / f"{photo.stem}.png")
    monkeypatch.setattr("clsplat.streaming.physical_memory", lambda: 2 * 9 * 7 * 40 * 32)
    flags = ["train", dataset, "-o", tmp_path / "run", "--method", "ingp-base", "--masks", masks]
    assert "expected photos that fit 0.1 MB, half of this machine" in fails(capsys, *flags)
    monkeypatch.setattr("clsplat.streaming.physical_memory", lambda: 2 * 9 * 8 * 40 * 32)
    train(dataset, tmp_path / "run", "--masks", masks)


def test_settings_of_gaussians_are_refused(dataset, tmp_path, capsys):
    def message(*flags, out=tmp_path / "run"):
        return fails(capsys, "train", dataset, "-o", out, "--method", "ingp-base", *flags)

    assert "found strategy, optim" in message("--strategy", "mcmc", "--optim.ssim-weight", "0.1")
    expected = "expected a folder after -o, no viewer and no blocks, found "
    assert f"{expected}-o {tmp_path / 'run.spz'}" in message(out=tmp_path / "run.spz")
    assert f"{expected}--viewer or --open" in message("--viewer")
    assert f"{expected}--scheduler or --print-jobs" in message("--print-jobs")
    assert "expected one of gaussians, nerf, nerf-small, plenoxels" in fails(
        capsys, "train", dataset, "-o", tmp_path, "--method", "nerd"
    )


def test_bench_draws_fields_beside_gaussians(dataset, tmp_path):
    """A third of the samples for the field, without a number of Gaussians; finished ones do not run again."""
    (tmp_path / "plain.json").write_text(json.dumps({"init": {"random_points": 50, "sh_degree": 1}}))
    flags = ["--methods", "ingp-base", tmp_path / "plain.json", "--iterations", 9, "-o", tmp_path / "out"]
    run("bench", "quality", dataset, *flags)
    records = read_records(tmp_path / "out" / "results.jsonl")
    fields = [r for r in records if r["method"] == "ingp-base"]
    assert [r["iteration"] for r in fields] == sample_iterations(9)[::3] == [1, 4, 9]
    last = fields[-1]
    assert last["num_gaussians"] is None and last["fps"] > 0 and last["memory_bytes"] > last["spz_bytes"] > 10**5
    assert {r["method"] for r in records if "fps" in r} == {"ingp-base", "plain"}
    assert "ingp-base" in (tmp_path / "out" / "index.html").read_text()
    run("bench", "quality", dataset, *flags)
    assert read_records(tmp_path / "out" / "results.jsonl") == records
