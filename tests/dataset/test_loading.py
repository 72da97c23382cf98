"""Loading folders as scenes: choice of the reader, split of the photos, origin, near plane."""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

from clsplat.camera import Camera
from clsplat.config import DataConfig, SfmConfig
from clsplat.dataset import load_scene
from clsplat.dataset.sfm import reconstruction as sfm
from clsplat.errors import InputError


def write_colmap(root, count=9, centre=(0.0, 0.0, 0.0)):
    """Photos on a line, looking along z, and two points in front of them, in COLMAP's text format."""
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (root / "images").mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 16 12 20 20 8 6\n")
    rows = []
    for k in range(count):
        Image.new("RGB", (16, 12), (k, 0, 0)).save(root / "images" / f"{k:02}.png")
        rows.append(f"{count - k} 1 0 0 0 {-centre[0] - k} {-centre[1]} {-centre[2]} 1 {k:02}.png\n\n")
    (model / "images.txt").write_text("".join(reversed(rows)))
    x, y, z = centre
    (model / "points3D.txt").write_text(f"1 {x} {y} {z + 5} 1 2 3 0\n2 {x + 0.25} {y} {z + 6} 4 5 6 0\n")


def write_transforms(root, names):
    matrix = np.diag([1.0, -1, -1, 1])
    rows = []
    for k, name in enumerate(names):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (16, 12), (k, 0, 0)).save(root / name)
        matrix[0, 3] = k
        rows.append({"file_path": name, "transform_matrix": matrix.tolist()})
    (root / "transforms.json").write_text(json.dumps({"fl_x": 20, "frames": rows}))


@pytest.mark.parametrize(("every", "test"), [(8, [0, 8]), (3, [0, 3, 6]), (0, [])])
def test_every_nth_photo_by_name_is_held_out(tmp_path, every, test):
    write_colmap(tmp_path)  # listed there in reverse order
    scene = load_scene(tmp_path, DataConfig(test_every=every))
    assert [view.name for view in scene.test] == [f"{k:02}.png" for k in test]
    assert [view.name for view in scene.train] == [f"{k:02}.png" for k in range(9) if k not in test]
    for view in scene.train + scene.test:
        assert view.image[0, 0, 0] == int(view.name[:2])
        np.testing.assert_allclose(view.camera.position, [int(view.name[:2]), 0, 0], atol=1e-12)


def test_nothing_left_to_train_on_is_an_error(tmp_path):
    write_colmap(tmp_path, count=1)
    with pytest.raises(InputError, match="test_every"):
        load_scene(tmp_path, DataConfig())
    assert len(load_scene(tmp_path, DataConfig(test_every=0)).train) == 1


def test_colmap_wins_over_transforms(tmp_path):
    write_colmap(tmp_path)
    write_transforms(tmp_path, ["other/a.png", "other/b.png"])
    assert load_scene(tmp_path, DataConfig()).train[0].name == "01.png"


def test_transforms_step_in_where_colmaps_photos_are_missing(tmp_path):
    write_colmap(tmp_path)
    for file in (tmp_path / "images").iterdir():
        file.unlink()
    with pytest.raises(InputError, match=r"00\.png|08\.png"):
        load_scene(tmp_path, DataConfig())
    write_transforms(tmp_path, ["other/a.png", "other/b.png"])
    assert load_scene(tmp_path, DataConfig()).train[0].name == "other/b.png"


@pytest.mark.parametrize("centre", [(5e6, -4e5, 3e5), (0.0, 0.0, 2e5)])
def test_scenes_far_from_the_origin_are_moved_to_it(tmp_path, centre):
    write_colmap(tmp_path / "far", centre=centre)
    write_colmap(tmp_path / "near")
    far, near = (load_scene(tmp_path / name, DataConfig()) for name in ("far", "near"))
    middle = np.array([4.0, 0.0, 0.0])  # mean position of the cameras, relative to `centre`
    np.testing.assert_allclose(far.offset, centre + middle, rtol=1e-15)
    # Apart from the translation, the same scene within the resolution of float64 at 5e6, 1e-9.
    np.testing.assert_allclose(far.points + middle, near.points, atol=4e-9)
    for one, other in zip(far.train + far.test, near.train + near.test, strict=True):
        np.testing.assert_allclose(one.camera.position + middle, other.camera.position, atol=4e-9)
        np.testing.assert_array_equal(one.camera.viewmat[:3, :3], other.camera.viewmat[:3, :3])
    assert far.extent == pytest.approx(near.extent)


@pytest.mark.parametrize(("screen", "expected"), [(192, (16, 12, 1)), (191, (8, 6, 2)), (47, (5, 4, 3))])
@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_photos_with_more_pixels_than_a_screen_are_reduced(tmp_path, monkeypatch, kind, screen, expected):
    """Photos of 16x12 pixels, and cameras far from the origin, which is moved."""
    monkeypatch.setattr("clsplat.dataset.finding.SCREEN", screen)
    if kind == "colmap":
        write_colmap(tmp_path, centre=(500_000.0, 0.0, 0.0))
    else:
        write_transforms(tmp_path, ["a.png", "b.png"])
    scene = load_scene(tmp_path, DataConfig())
    camera = scene.train[0].camera
    assert (camera.width, camera.height, scene.downscale) == expected
    assert camera.fx == pytest.approx(20 / expected[2])
    full = load_scene(tmp_path, DataConfig(downscale=1))
    assert full.train[0].camera.width == 16 and full.downscale == 1


def test_scenes_near_the_origin_stay(tmp_path):
    write_colmap(tmp_path, centre=(3000.0, 0.0, 0.0))  # extent 4.4: less than 1000 extents
    scene = load_scene(tmp_path, DataConfig())
    np.testing.assert_array_equal(scene.offset, 0)
    np.testing.assert_array_equal(scene.points[0], [3000, 0, 5])


@pytest.mark.parametrize(
    ("change", "message"),
    [({"downscale": 17}, "downscale"), ({"test_every": -1}, "--test-every"), ({"masks": "m"}, "masks")],
)
def test_bad_options_are_refused(tmp_path, change, message):
    write_colmap(tmp_path)
    with pytest.raises(InputError, match=message):
        load_scene(tmp_path, dataclasses.replace(DataConfig(), **change))


def test_folders_without_anything_usable_are_refused(tmp_path):
    with pytest.raises(InputError, match="nothing"):
        load_scene(tmp_path / "absent", DataConfig())
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="a file"):
        load_scene(tmp_path / "file", DataConfig())
    with pytest.raises(InputError, match=r"COLMAP.*transforms\.json.*photos"):
        load_scene(tmp_path, DataConfig())


def test_photos_alone_are_handed_to_structure_from_motion(tmp_path, monkeypatch):
    write_colmap(tmp_path)
    (tmp_path / "sparse").rename(tmp_path / "made")
    asked = []

    def reconstruct(photos, config, output, verbose):
        asked.append((photos, config, output))
        (tmp_path / "made").rename(tmp_path / "sparse")
        return tmp_path / "sparse" / "0"

    monkeypatch.setattr(sfm, "reconstruct", reconstruct)
    options = SfmConfig(matching="sequential")
    scene = load_scene(tmp_path, DataConfig(sfm=options))
    assert asked == [(tmp_path, options, tmp_path)]
    assert len(scene.train) == 7 and isinstance(scene.train[0].camera, Camera)
