"""Summary of structure from motion: figures of the model, warnings at thresholds, a picture."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from clsplat.camera import Camera
from clsplat.commands.console import picture_cameras, say_cameras
from clsplat.config import SfmConfig
from clsplat.dataset.photos import photo_sharpness
from clsplat.dataset.sfm.reconstruction import RECORD
from clsplat.dataset.sfm.summary import Preview, SparseModel, draw_cameras, preview, read_sparse
from clsplat.errors import InputError

NAMES = ["a.png", "b.png", "c.png"]


@pytest.fixture
def model():
    rng = np.random.default_rng(0)
    directions = np.array([[0.0, 0, 1], [1, 0, 0], [0, 0, -1]])
    points, colors = rng.normal(size=(500, 3)), rng.integers(0, 256, (500, 3), np.uint8)
    return SparseModel(NAMES, -5 * directions, directions, np.array([300, 200, 100]), points, colors, 0.5, 4.0)


def texture(seed=0):
    return np.random.default_rng(seed).uniform(0, 255, (60, 80)).astype(np.uint8)


def test_a_good_model_has_no_warning(model):
    found = Preview(NAMES, model, np.array([1.0, 0.9, 1.1]))
    assert found.warnings() == []
    assert found.summary() == (
        "3 of 3 photos have a pose; 500 points, each seen in 4.0 photos; mean reprojection error 0.50 px"
    )


@pytest.mark.parametrize(
    ("change", "sharpness", "words"),
    [
        ({"track_length": 2.4}, 1.0, "points are seen in 2.4 photos on average: photos overlap too little"),
        ({"error": 1.6}, 1.0, "the mean reprojection error of 1.6 px is large"),
        (
            {"points_seen": np.array([300, 49, 50])},
            1.0,
            "poses are doubtful, from fewer than 50 points: 1 of 3 photos: b.png$",
        ),
        ({}, 0.29, "blurred compared with the others: 1 of 3 photos: c.png;"),
    ],
)
def test_each_fault_has_its_warning(model, change, sharpness, words):
    (warning,) = Preview(NAMES, replace(model, **change), np.array([1, 1, sharpness])).warnings()
    assert re.match(words, warning)


def test_photos_without_a_pose_are_named(model):
    names = [*NAMES, *(f"z{k:02}.png" for k in range(12))]
    found = Preview(names, model, np.ones(15))
    (warning,) = found.warnings()
    listed = ", ".join(f"z{k:02}.png" for k in range(10))
    assert warning.startswith("no pose was found for 12 of 15 photos") and f"{listed} and 2 more;" in warning
    assert found.summary().startswith("3 of 15 photos")


def test_warnings_take_time_in_proportion_to_the_photos(model):
    """Thousands of photos took minutes: everything was read again for each of them."""
    passes = []

    class Counted(list):
        def __iter__(self):
            passes.append(None)
            return super().__iter__()

    names = [f"{k}.jpg" for k in range(50)]
    Preview(names, replace(model, names=Counted(model.names)), np.ones(50)).warnings()
    assert len(passes) < 5


@pytest.fixture
def dataset(tmp_path):
    """Photos, one of them blurred and one without a pose, with a model written by pycolmap."""
    import pycolmap

    record = {"photos": ".", "registered": 3, "options": vars(SfmConfig()), "hashes": {}}
    for name in (*NAMES, "d.png"):
        pixels = gaussian_filter(texture(), 3) if name == "b.png" else texture()
        Image.fromarray(pixels).save(tmp_path / name)
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (tmp_path / "sparse" / RECORD).write_text(json.dumps(record))
    (folder / "cameras.txt").write_text("1 PINHOLE 80 60 70 70 40 30\n")
    lines = []
    for k, name in enumerate(NAMES):
        camera = Camera.look_at((3 * (k - 1), 0, -5), (0, 0, 0), (0, -1, 0), 70, 80, 60)
        quat = pycolmap.Rotation3d(camera.viewmat[:3, :3]).quat  # xyzw
        pose = " ".join(map(str, [quat[3], *quat[:3], *camera.viewmat[:3, 3]]))
        lines.append(f"{k + 1} {pose} 1 {name}\n41 30 1 5 5 -1\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("1 0 0 0 10 20 30 1.0 1 0 2 0 3 0\n")
    return tmp_path


def test_the_model_is_read(dataset):
    model = read_sparse(dataset / "sparse" / "0")
    assert model.names == NAMES and model.track_length == 3 and model.error == pytest.approx(1.0)
    np.testing.assert_allclose(model.positions, [[-3, 0, -5], [0, 0, -5], [3, 0, -5]], atol=1e-9)
    np.testing.assert_allclose(
        model.directions, -model.positions / np.linalg.norm(model.positions, axis=1)[:, None], atol=1e-9
    )
    assert model.points_seen.tolist() == [1, 1, 1]
    np.testing.assert_array_equal(model.colors, [[10, 20, 30]])
    with pytest.raises(InputError, match=r"cannot find .*cameras\.bin"):
        read_sparse(dataset)


def test_what_was_found_is_said_and_drawn(dataset, tmp_path, capsys):
    found = preview(dataset)
    assert found.photos == [*NAMES, "d.png"]
    say_cameras(dataset)
    picture_cameras(dataset, tmp_path / "cameras.png")
    error = capsys.readouterr().err
    assert "cameras: 3 of 4 photos have a pose; 1 points" in error
    assert "no pose was found for 1 of 4 photos: d.png;" in error and "blurred compared with the others" in error
    assert "drawn in" in error and "cameras.png" in error
    with Image.open(tmp_path / "cameras.png") as image:
        assert image.width > 800


def test_cameras_of_others_are_not_commented(tmp_path, capsys):
    say_cameras(tmp_path)
    picture_cameras(tmp_path, tmp_path / "cameras.png")
    assert capsys.readouterr().err == "" and not (tmp_path / "cameras.png").exists()


def test_the_picture_shows_cameras_and_points(model, tmp_path):
    draw_cameras(tmp_path / "a.png", model)
    draw_cameras(tmp_path / "b.png", replace(model, points=model.points[:0], colors=model.colors[:0]))
    with Image.open(tmp_path / "a.png") as a, Image.open(tmp_path / "b.png") as b:
        a, b = np.asarray(a.convert("RGB")).astype(int), np.asarray(b.convert("RGB")).astype(int)
    orange = (np.abs(a - (213, 94, 0)).max(axis=2) < 40).sum()
    assert orange > 500 and (b == 255).mean() > (a == 255).mean()


def test_the_sharpness_of_a_photo_does_not_depend_on_its_size(tmp_path):
    image = Image.fromarray(gaussian_filter(np.kron(texture(), np.ones((8, 8), np.uint8)), 2))
    image.save(tmp_path / "small.png")
    image.resize((1280, 960)).save(tmp_path / "large.png")
    small, large = photo_sharpness(tmp_path / "small.png"), photo_sharpness(tmp_path / "large.png")
    assert small == pytest.approx(large, rel=0.35)
