"""The folder of a run as the argument of each command that takes a scene."""

import json
import shutil
import zipfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import TRAIN, fails, read_image, run
from test_info import info

from clsplat.cli import main
from clsplat.commands.run_folders import read_run
from clsplat.commands.train import Train
from clsplat.formats import load_gaussians
from clsplat.training.memory import bytes_text

SETTINGS = ("--downscale", 2, "--background", "white", "--test-every", 3, "--mode", "antialiased")


@pytest.fixture(scope="module")
def white(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose settings differ from the defaults."""
    out = tmp_path_factory.mktemp("runs") / "white"
    run("train", dataset, "-o", out, *TRAIN, *SETTINGS)
    return out


@pytest.fixture
def copied(white: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(white, tmp_path / "run"))


def metrics(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def test_eval_repeats_the_evaluation_of_the_run(copied: Path, tmp_path: Path) -> None:
    first = metrics(copied / "eval")
    run("eval", copied, "-o", tmp_path / "again")
    again = metrics(tmp_path / "again")
    assert [v["name"] for v in again["views"]] == [v["name"] for v in first["views"]] == ["0.png", "3.png", "6.png"]
    assert again["mean"]["psnr"] == pytest.approx(first["mean"]["psnr"], abs=0.01)
    shutil.rmtree(copied / "eval")
    run("eval", copied)
    assert metrics(copied / "eval") == again


def test_commands_triangulate_where_the_training_did(copied: Path, tmp_path: Path, monkeypatch) -> None:
    """Near planes of triangulated points would differ from those of a training without them."""
    asked = []
    monkeypatch.setattr("clsplat.dataset.loading.with_points", lambda scene, *_: asked.append(scene) or scene)
    run("eval", copied)
    run("render", copied)
    run("mesh", copied, "-o", tmp_path / "mesh.ply", "--resolution", 16)
    assert not asked
    config = json.loads((copied / "config.json").read_text())
    config["init"]["triangulate"] = True
    (copied / "config.json").write_text(json.dumps(config))
    run("eval", copied)
    assert len(asked) == 1


def test_flags_and_arguments_count_more_than_the_run(copied: Path, dataset: Path, tmp_path: Path) -> None:
    run("eval", copied, dataset, "-o", tmp_path / "a", "--test-every", 4, "--downscale", 1)
    assert [v["name"] for v in metrics(tmp_path / "a")["views"]] == ["0.png", "4.png", "8.png"]
    assert read_image(tmp_path / "a" / "render" / "0.png").shape == (32, 40, 3)


def test_render_writes_into_the_run(copied: Path) -> None:
    run("render", copied)
    assert sorted(p.name for p in (copied / "render").iterdir()) == ["0.png", "3.png", "6.png"]
    picture, expected = read_image(copied / "render" / "3.png"), read_image(copied / "eval" / "render" / "3.png")
    assert picture.shape == (16, 20, 3)
    assert np.abs(picture.astype(int) - expected).max() <= 1


def test_a_flag_of_a_command_can_be_given_with_a_run(copied: Path, tmp_path: Path) -> None:
    run("render", copied, "-o", tmp_path / "images", "--depth")
    assert sorted(p.name for p in (tmp_path / "images").glob("3*")) == ["3.png", "3_depth.png"]


def test_export_of_a_scene_and_of_a_page_with_the_cameras_of_the_run(
    copied: Path, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("export", copied, tmp_path / "copy.ply")
    assert (tmp_path / "copy.ply").read_bytes() == (copied / "scene.ply").read_bytes()
    starts: list[tuple] = []
    monkeypatch.setattr("clsplat.show.web_page.save_page", lambda out, *rest: (starts.append(rest), out.touch()))
    run("export", copied, tmp_path / "a.html")
    run("export", copied / "scene.ply", tmp_path / "b.html", "--data", dataset, "--background", "white")
    ours, given = starts
    assert ours[3] == given[3] == "white"
    # The run has 2 photos fewer to train on than the dataset by default, but 0.png is held out in both.
    np.testing.assert_array_equal(ours[2].camera.viewmat, given[2].camera.viewmat)


@pytest.mark.filterwarnings("ignore:.*the scene matches the photos with only")
def test_compact_compares_with_the_photos_of_the_run(copied: Path, tmp_path: Path, capsys) -> None:
    run("compact", copied, "-o", tmp_path / "small.ply", "--max-gaussians", 100)
    assert "against the evaluation photos" in capsys.readouterr().err
    assert len(load_gaussians(tmp_path / "small.ply")[0]) == 100


@pytest.mark.parametrize("part", [".", "meta.json"])
def test_compact_tells_the_size_of_all_files_of_a_scene(
    white: Path, dataset: Path, tmp_path: Path, capsys, part: str
) -> None:
    run("export", white / "scene.ply", tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "sog")
    files = sum(path.stat().st_size for path in (tmp_path / "sog").iterdir())
    run("compact", tmp_path / "sog" / part, "-o", tmp_path / "b.ply", "--cameras", dataset, "--max-gaussians", 100)
    assert f", {bytes_text(files)}\n" in capsys.readouterr().err


def test_info_tells_scores_and_settings(copied: Path, dataset: Path, capsys) -> None:
    rows, _ = info(copied, capsys)
    mean = metrics(copied / "eval")["mean"]
    assert rows["held-out PSNR"] == f"{mean['psnr']:.2f} dB" and rows["held-out SSIM"] == f"{mean['ssim']:.3f}"
    assert rows["dataset"] == str(dataset.resolve()) and rows["iterations"] == "20 of 20"
    found = rows["settings"].split()
    for name, value in zip(SETTINGS[::2], SETTINGS[1::2], strict=True):
        assert found[found.index(name) + 1] == str(value)
    assert "--few" not in rows["settings"] and "--device" not in found


def test_a_run_that_is_not_finished_says_so(copied: Path, capsys) -> None:
    (copied / "scene.ply").unlink()
    message = fails(capsys, "export", copied, "a.ply")
    assert (
        message
        == f"clsplat: {copied}: expected a finished run, found no scene.ply in it; it is in progress, or "
        + ("--resume finishes it")
    )


def test_a_missing_dataset_is_needed_only_where_photos_are(copied: Path, tmp_path: Path, capsys) -> None:
    config = json.loads((copied / "config.json").read_text())
    (copied / "config.json").write_text(json.dumps(config | {"data_path": str(tmp_path / "gone")}))
    assert fails(capsys, "eval", copied).startswith("clsplat: eval: expected a dataset")
    run("export", copied, tmp_path / "a.html")
    assert f"warning: {tmp_path / 'gone'}, the dataset of {copied}, is missing" in capsys.readouterr().err


def test_without_a_run_the_dataset_and_the_folder_are_needed(white: Path, dataset: Path, capsys) -> None:
    assert "found none" in fails(capsys, "eval", white / "scene.ply", "-o", "x")
    assert "-o: expected a folder" in fails(capsys, "render", white / "scene.ply", dataset)


def test_a_dataset_within_the_run_moves_with_it_and_a_video_is_its_frames(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    video = tmp_path / "film.mp4"
    video.touch()
    for named, expected in (("photos", folder / "photos"), (str(video), folder / "frames"), (None, None)):
        settings = asdict(replace(Train(Path(), Path()).settings, iterations=5))
        (folder / "config.json").write_text(json.dumps({"data_path": named, **settings} if named else settings))
        assert read_run(folder).data == expected
        assert read_run(folder).config.iterations == 5


def test_a_damaged_configuration_is_named(copied: Path, capsys) -> None:
    (copied / "config.json").write_text("[")
    with pytest.raises(SystemExit):
        main(["view", str(copied)])
    assert f"{copied / 'config.json'}: expected JSON" in capsys.readouterr().err
