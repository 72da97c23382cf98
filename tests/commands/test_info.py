"""The output of `clsplat info` for files of every format, runs and datasets."""

import json
import shutil
import warnings

import numpy as np
import pytest
from bounds import HOLDS
from PIL import Image
from test_colmap import IMAGES, write_photos, write_txt

from clsplat.cli import main
from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.formats import FORMATS, save_gaussians
from clsplat.testing import synthetic_scene

N = 300


def info(path, capsys):
    """Run `clsplat info`; return the rows of the table by name, and the whole text."""
    main(["info", str(path)])
    text = capsys.readouterr().out
    rows = [line.strip().split("  ", 1) for line in text.splitlines() if line.startswith("  ")]
    # A part of a file may have the name of a row of the table, which precedes it.
    return {name: value.strip() for name, value in reversed(rows)}, text


@pytest.fixture
def gaussians():
    scene = synthetic_scene(N, seed=2, sh_degree=2)[0].astype(np.float32)
    scene.means[0] = -7, 1, 0
    scene.means[1] = 5, 3, 2
    scene.means[2:] = np.clip(scene.means[2:], -2, 2)
    scene.means[2:, 1] = np.clip(scene.means[2:, 1], 1, 2)
    scene.means[2:, 2] = np.clip(scene.means[2:, 2], 0, 2)
    return scene


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_tells_what_it_holds(gaussians, suffix, tmp_path, capsys):
    path = tmp_path / f"a{suffix}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about data that the format cannot hold
        save_gaussians(path, gaussians, "antialiased", (1000, 0, -20))
    rows, text = info(path, capsys)
    anatomy = FORMATS[suffix].anatomy(path)
    assert rows["format"] == anatomy.format
    assert rows["Gaussians"] == f"{N}"
    assert rows["sh degree"] == ("2" if "sh" in HOLDS[suffix] else "0")
    assert rows["mode"] == ("antialiased" if "mode" in HOLDS[suffix] else "classic")
    low, high = (np.array(eval(end)) for end in rows["bounds"].split(" to "))
    np.testing.assert_allclose([low, high], [[-7, 1, 0], [5, 3, 2]], atol=0.02)
    assert ("offset" in rows) == ("offset" in HOLDS[suffix])
    if "offset" in rows:
        assert rows["offset"].startswith("(1000, 0, -20)")
    # The parts make up the whole file, except for the directory of a ZIP and the headers of compressed files.
    whole = sum(anatomy.parts.values())
    if suffix == ".spz":
        assert anatomy.packed and whole == N * (9 + 1 + 3 + 3 + 4 + 24)
    elif not anatomy.packed:
        assert 0 <= path.stat().st_size - whole <= (2000 if suffix == ".sog" else 0)
    for name in anatomy.parts:
        assert f"\n  {name} " in text


def test_comments_are_shown(gaussians, tmp_path, capsys):
    save_gaussians(tmp_path / "a.ply", gaussians, "antialiased")
    assert info(tmp_path / "a.ply", capsys)[0]["comments"] == "SplatRenderMode: mip"


def test_parts_of_a_ply(gaussians, tmp_path):
    save_gaussians(tmp_path / "a.ply", gaussians)
    parts = FORMATS[".ply"].anatomy(tmp_path / "a.ply").parts
    assert parts.pop("header") > 100
    assert parts == {
        **{"means": 12 * N, "normals, unused": 12 * N, "colours (sh of band 0)": 12 * N, "sh above band 0": 96 * N},
        **{"opacities": 4 * N, "scales": 12 * N, "quaternions": 16 * N},
    }


def test_places_and_ranges_by_hand(tmp_path, capsys):
    """101 Gaussians from 0 to 100; a negative zero is none; a value between two ranges is in the upper one."""
    found = synthetic_scene(101, seed=2)[0].astype(np.float32)
    found.means[:] = 0
    found.means[:, 0], found.means[:, 1] = np.arange(101), -0.0
    found.logit_opacities[:] = 0
    save_gaussians(tmp_path / "a.ply", found)
    rows, _ = info(tmp_path / "a.ply", capsys)
    assert rows["bounds"] == "(0, 0, 0) to (100, 0, 0)" and rows["middle"] == "(50, 0, 0)"
    assert rows["98 % within"] == "(1, 0, 0) to (99, 0, 0)"
    assert rows["0.5 to 0.6"].split("  ") == ["100.0 %", "#" * 40]


def test_histograms_count_every_gaussian(gaussians, tmp_path, capsys):
    gaussians.logit_opacities[:100] = 10
    gaussians.logit_opacities[100:] = -10
    gaussians.log_scales[:] = np.log(0.5)
    save_gaussians(tmp_path / "a.ply", gaussians)
    rows, text = info(tmp_path / "a.ply", capsys)
    assert rows["0.9 to 1"].split("  ") == ["33.3 %", "#" * 20]
    assert rows["0 to 0.1"].split("  ") == ["66.7 %", "#" * 40]
    sizes = text.split("size: geometric")[1]
    assert sizes.count("100.0 %") == 1 and sizes.count(" 0.0 %") == 9


def test_an_unpacked_sog(gaussians, tmp_path, capsys):
    import zipfile

    save_gaussians(tmp_path / "a.sog", gaussians)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "unpacked")
    (tmp_path / "unpacked" / "notes.txt").write_text("not the scene's")
    for path in (tmp_path / "unpacked", tmp_path / "unpacked" / "meta.json"):
        rows, text = info(path, capsys)
        assert (
            rows["format"] == "SOG (PlayCanvas), version 2, in a folder" and rows["comments"] == "generator: clsplat"
        )
        assert "notes.txt" not in text and "0.0 bytes" not in rows["size"]


def test_a_run(gaussians, tmp_path, capsys):
    record = {"iteration": 30, "num_gaussians": 123, "seconds": 4.2, "loss": 0.1, "psnr": 21.5}
    (tmp_path / "log.jsonl").write_text(json.dumps(record) + "\n")
    (tmp_path / "config.json").write_text(json.dumps({"iterations": 40, "data_path": str(tmp_path / "data")}))
    assert info(tmp_path, capsys)[0]["dataset"] == f"{tmp_path / 'data'}, missing"
    (tmp_path / "data").mkdir()
    rows, _ = info(tmp_path, capsys)
    assert rows["dataset"] == f"{tmp_path / 'data'}"
    assert rows["iterations"] == "30 of 40" and rows["held-out PSNR"] == "21.50 dB" and rows["Gaussians"] == "123"
    assert "--resume" in rows["scene.ply"]
    save_gaussians(tmp_path / "scene.ply", gaussians)
    rows, _ = info(tmp_path, capsys)
    assert "scene.ply" not in rows and rows["Gaussians"] == f"{N}" and rows["iterations"] == "30 of 40"
    (tmp_path / "config.json").write_text("[")
    with pytest.raises(SystemExit):
        main(["info", str(tmp_path)])
    assert "config.json: expected JSON" in capsys.readouterr().err


@pytest.mark.parametrize("begun", ["checkpoint.npz", "blocks/plan.json", "log.jsonl"])
def test_a_run_that_has_just_begun(tmp_path, capsys, begun):
    """Before iteration 10 the log is empty, and that of a training in blocks is written at its end."""
    (tmp_path / "config.json").write_text(json.dumps({"iterations": 40, "data_path": str(tmp_path / "data")}))
    (tmp_path / begun).parent.mkdir(exist_ok=True)
    (tmp_path / begun).touch()
    rows, _ = info(tmp_path, capsys)
    assert rows["iterations"] == "0 of 40" and "--resume" in rows["scene.ply"] and "Gaussians" not in rows


def test_a_field_that_has_just_begun(tmp_path, capsys):
    (tmp_path / "config.json").write_text(json.dumps({"iterations": 40, "method": "ingp-base"}))
    rows, _ = info(tmp_path, capsys)
    assert "ingp-base" in rows["what"] and "--resume" in rows["field.npz"]


def test_smaller_copies_alone(tmp_path, capsys):
    (tmp_path / "images_2").mkdir()
    Image.new("RGB", (20, 10)).save(tmp_path / "images_2" / "0.png")
    frames = [{"file_path": "images/0.png", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "w": 40, "h": 20, "frames": frames}))
    rows, _ = info(tmp_path, capsys)
    assert (rows["photos"], rows["sizes"], rows["smaller copies"]) == ("1", "1 of 20x10", "1 in images_2")


def test_photos_and_transforms(tmp_path, capsys):
    for k, width in enumerate((40, 40, 30)):
        Image.new("RGB", (width, 20)).save(tmp_path / f"{k}.png")
    rows, _ = info(tmp_path, capsys)
    assert rows == {
        "what": "photos without cameras: train or sfm recovers them",
        **{"photos": "3", "sizes": "2 of 40x20, 1 of 30x20"},
    }
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose} for k in range(2)]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "w": 40, "h": 20, "frames": frames}))
    rows, _ = info(tmp_path, capsys)
    assert rows["what"] == "transforms.json" and rows["poses"] == "2" and rows["points"] == "0"
    assert rows["cameras"] == "2 of PINHOLE 40x20" and rows["sizes"] == "2 of 40x20"


def test_a_dataset_is_that_which_train_reads(tmp_path, capsys):
    """A COLMAP model whose photos are in folders beside it; the transforms.json if there are none."""
    images = [(f"cam0/{name}", camera, *pose) for name, camera, *pose in IMAGES]
    write_txt(tmp_path / "sparse" / "0", images=images)
    write_photos(tmp_path, images)
    rows, _ = info(tmp_path, capsys)
    assert (rows["what"], rows["photos"], rows["poses"]) == ("COLMAP model", "3", "3")
    assert rows["sizes"] == "2 of 64x48, 1 of 40x30"
    shutil.rmtree(tmp_path / "cam0")
    Image.new("RGB", (40, 20)).save(tmp_path / "0.png")
    frames = [{"file_path": "0.png", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "frames": frames}))
    rows, _ = info(tmp_path, capsys)
    assert rows["what"] == "transforms.json" and rows["photos"] == rows["poses"] == "1" and "model" not in rows
    assert [view.name for view in load_scene(tmp_path, DataConfig(test_every=0)).train] == ["0.png"]


def test_a_colmap_model(shared, capsys):
    rows, _ = info(shared / "data" / "castle_p30", capsys)
    assert rows["what"] == "COLMAP model" and rows["poses"] == "30" and rows["sizes"] == "30 of 768x512"
    assert rows["cameras"] == "30 of PINHOLE 768x512" and rows["points"] == "12,914"
    rows, _ = info(shared / "data" / "fox", capsys)
    assert rows["photos"] == "0" and rows["smaller copies"].startswith("50 in images_2")


def test_what_is_nothing_is_said(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for path, found in ((tmp_path / "none", "found nothing"), (tmp_path / "empty", "neither photos nor cameras")):
        with pytest.raises(SystemExit):
            main(["info", str(path)])
        assert found in capsys.readouterr().err
