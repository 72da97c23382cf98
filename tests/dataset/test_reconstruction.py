"""Structure from motion on rendered photos with known cameras, and its model on disk."""

import json
import os
import re
import shutil
import tempfile

import numpy as np
import pytest
from PIL import Image
from small_files import small_files
from textured_corner import CONFIG, cameras, take_photos

from clsplat.commands.info import dataset_lines
from clsplat.config import DataConfig, SfmConfig
from clsplat.dataset import load_scene
from clsplat.dataset.colmap import read_model
from clsplat.dataset.lenses import Intrinsics, is_pinhole, undistorted
from clsplat.dataset.sfm import reconstruction
from clsplat.dataset.sfm.reconstruction import RECORD, WORK, read_record, reconstruct
from clsplat.errors import InputError

FILES = ["cameras.bin", "images.bin", "points3D.bin"]


def test_known_cameras_are_recovered(solved):
    scene = load_scene(solved, DataConfig(test_every=0))
    assert [view.name for view in scene.train] == [f"photo {k}.png" for k in range(4)]
    found, true = (np.array([c.position for c in cs]) for cs in ([v.camera for v in scene.train], cameras()))
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(true.T @ found)  # Umeyama 1991
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = u @ sign @ vt, np.trace(np.diag(s) @ sign) / (found**2).sum()
    # Measured: 0.06 %. A pixel at this focal length is 0.3 % of the distance.
    assert (
        np.linalg.norm(scale * found @ rotation.T - true, axis=1).max() < 0.003 * np.linalg.norm(true, axis=1).max()
    )
    for view, camera in zip(scene.train, cameras(), strict=True):
        relative = view.camera.viewmat[:3, :3] @ rotation.T @ camera.viewmat[:3, :3].T
        assert np.degrees(np.arccos(min((np.trace(relative) - 1) / 2, 1))) < 0.2
        assert view.camera.fx == pytest.approx(300, rel=0.01)
    assert len(scene.points) > 500 and scene.colors.std() > 20


def test_the_world_is_upright(solved):
    scene = load_scene(solved, DataConfig(test_every=0))
    down = np.mean([view.camera.viewmat[1, :3] for view in scene.train], axis=0)
    np.testing.assert_allclose(down / np.linalg.norm(down), [0, 1, 0], atol=1e-9)


def test_nothing_but_model_and_record_stays(solved):
    assert sorted(os.listdir(solved)) == [*(f"photo {k}.png" for k in range(4)), "sparse"]
    assert sorted(os.listdir(solved / "sparse")) == ["0", RECORD]
    record = read_record(solved)
    assert record["photos"] == "." and record["registered"] == 4
    assert SfmConfig(**record["options"]) == CONFIG and sorted(record["hashes"]) == [
        f"photo {k}.png" for k in range(4)
    ]


def test_unlike_photos_are_turned_first_and_give_the_same_model(solved, photos, tmp_path, capfd):
    """EXIF orientation and transparency: structure from motion reads the same pixels as training."""
    folder = tmp_path / "images"  # the dataset is the folder above
    folder.mkdir()
    for k, (photo, tag) in enumerate(zip(photos, (6, 3, 1, 1), strict=True)):
        stored = {6: photo[:, ::-1].swapaxes(0, 1), 3: photo[::-1, ::-1], 1: photo}[tag]
        if k == 2:
            stored = np.dstack([stored, np.full(stored.shape[:2], 255, np.uint8)])
        exif = Image.Exif()
        exif[0x0112] = tag
        Image.fromarray(stored).save(folder / f"photo {k}.png", exif=exif)
    model = reconstruct(tmp_path, CONFIG)
    # The same pixels and the same seed give the same bytes on one machine.
    for name in FILES:
        assert (model / name).read_bytes() == (solved / "sparse" / "0" / name).read_bytes()
    scene = load_scene(tmp_path, DataConfig(test_every=0))
    plain = load_scene(solved, DataConfig(test_every=0))
    for view, other in zip(scene.train, plain.train, strict=True):
        np.testing.assert_array_equal(view.image, other.image)
        np.testing.assert_array_equal(view.camera.viewmat, other.camera.viewmat)
    err = capfd.readouterr().err
    for stage in ("check photos", "features", "matches", "poses"):
        assert stage in err
    assert not re.search(r"^[IWE]\d{8} ", err, re.MULTILINE)  # COLMAP's log


def test_a_fresh_model_is_reused(copy, runs):
    before = (copy / "sparse" / "0" / "images.bin").stat().st_mtime_ns
    assert reconstruct(copy, CONFIG) == copy / "sparse" / "0"
    os.utime(copy / "photo 0.png")  # copied or touched, not changed
    load_scene(copy, DataConfig())
    assert not runs and (copy / "sparse" / "0" / "images.bin").stat().st_mtime_ns == before


@pytest.mark.parametrize("change", ["changed", "added", "removed", "options", "lost"])
def test_a_stale_model_is_redone(copy, runs, change):
    config = CONFIG
    if change == "changed":
        Image.new("RGB", (320, 240)).save(copy / "photo 1.png")
    elif change == "added":
        shutil.copy(copy / "photo 1.png", copy / "photo 9.png")
    elif change == "removed":
        (copy / "photo 1.png").unlink()
    elif change == "options":
        config = SfmConfig(camera_model="SIMPLE_RADIAL", matching="sequential")
    else:
        (copy / "sparse" / "0" / "images.bin").unlink()
    reconstruct(copy, config)
    assert len(runs) == 1
    reconstruct(copy, config)
    assert len(runs) == 1
    assert sorted(os.listdir(copy / "sparse")) == ["0", RECORD]


def test_loading_notices_changed_photos_and_keeps_the_options(copy, runs):
    Image.new("RGB", (320, 240)).save(copy / "photo 1.png")
    load_scene(copy, DataConfig())
    assert len(runs) == 1 and SfmConfig(**read_record(copy)["options"]) == CONFIG
    load_scene(copy, DataConfig(sfm=SfmConfig(max_image_size=200)))
    assert len(runs) == 2 and read_record(copy)["options"]["max_image_size"] == 200


def test_the_model_can_be_put_elsewhere(solved, tmp_path, runs):
    photos = tmp_path / "photos"
    photos.mkdir()
    for k in range(4):
        shutil.copy(solved / f"photo {k}.png", photos)
    output = tmp_path / "deep" / "model"
    assert reconstruct(photos, CONFIG, output) == output / "sparse" / "0"
    assert len(os.listdir(photos)) == 4
    scene = load_scene(output, DataConfig(test_every=0))
    beside = load_scene(solved, DataConfig(test_every=0))
    np.testing.assert_array_equal(scene.train[2].image, beside.train[2].image)
    shutil.rmtree(photos)
    with pytest.raises(InputError, match=r"photos.*nothing"):
        load_scene(output, DataConfig())


def test_too_few_poses_are_refused_and_leave_nothing(tmp_path):
    rng = np.random.default_rng(1)
    for k in range(3):
        Image.fromarray(rng.integers(0, 256, (96, 128, 3)).astype(np.uint8)).save(tmp_path / f"{k}.png")
    with pytest.raises(InputError, match=r"poses of 0 of 3 photos, expected at least 3.*overlap"):
        reconstruct(tmp_path, CONFIG)
    assert sorted(os.listdir(tmp_path)) == ["0.png", "1.png", "2.png"]


def test_a_cached_model_must_have_enough_poses_too(copy, runs):
    shutil.copy(copy / "photo 3.png", copy / "photo 4.png")
    reconstruct(copy, CONFIG)  # `runs` yields a model of 4 photos
    with pytest.raises(InputError, match="poses of 4 of 5 photos, expected at least 5"):
        reconstruct(copy, SfmConfig(camera_model="SIMPLE_RADIAL", min_registered=5))
    assert len(runs) == 1


def test_of_two_models_the_larger_is_taken(photos, tmp_path):
    for k, photo in enumerate(take_photos(1)[:3]):
        Image.fromarray(photo).save(tmp_path / f"a{k}.png")
    for k, photo in enumerate(photos):
        Image.fromarray(photo).save(tmp_path / f"b{k}.png")
    _, images, *_ = read_model(reconstruct(tmp_path, CONFIG))
    assert sorted(name for name, _, _ in images) == ["b0.png", "b1.png", "b2.png", "b3.png"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"matching": "random"}, "matching"),
        ({"camera_model": "PINBALL"}, "--sfm.camera-model.*SIMPLE_RADIAL"),
        ({"camera_model": "EQUIRECTANGULAR"}, "--sfm.camera-model"),
        ({"max_image_size": 0}, "--sfm.max-image-size"),
    ],
)
def test_bad_options_are_refused(solved, options, message):
    with pytest.raises(InputError, match=message):
        reconstruct(solved, SfmConfig(**options))


def test_a_photo_of_one_row_is_refused(copy):
    """COLMAP reduces it to zero rows and crashes."""
    Image.fromarray(np.zeros((1, 4000, 3), np.uint8)).save(copy / "row.png")
    with pytest.raises(InputError, match=r"row\.png: expected an aspect ratio of at most .* found 4000x1"):
        reconstruct(copy, CONFIG)


def test_folders_that_cannot_be_used_are_refused(solved, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="expected at least 3 photos, found 0"):
        reconstruct(tmp_path, CONFIG)
    with pytest.raises(InputError, match=r"absent.*nothing"):
        reconstruct(tmp_path / "absent", CONFIG)
    for k in range(4):
        shutil.copy(solved / f"photo {k}.png", tmp_path)

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:  # the tests may run as root, who can write anywhere
        patch.setattr(tempfile, "mkdtemp", refuse)
        with pytest.raises(InputError, match=r"Permission denied.*copy the photos.*-o DIR"):
            reconstruct(tmp_path, CONFIG)
    (tmp_path / "photo 2.png").write_bytes(b"no photo")
    with pytest.raises(InputError, match=r"photo 2\.png"):
        reconstruct(tmp_path, CONFIG)
    assert len(os.listdir(tmp_path)) == 4
    (tmp_path / "sparse").mkdir()
    with pytest.raises(InputError, match="found another model"):
        reconstruct(tmp_path, CONFIG)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", json.dumps({"options": {"speed": 9}, "hashes": {}, "registered": 1})]
)
def test_damaged_records_are_refused_by_name(tmp_path, text):
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse" / RECORD).write_text(text)
    with pytest.raises(InputError, match=rf"{RECORD}.*delete"):
        read_record(tmp_path)


def test_portrait_and_landscape_are_two_cameras(tmp_path, photos):
    """A single COLMAP camera has one size; COLMAP silently drops photos of another size."""
    for k, photo in enumerate(photos):
        Image.fromarray(photo[:, 40:280] if k in (1, 2) else photo).save(tmp_path / f"{k}.png")
    cameras, images, *_ = read_model(reconstruct(tmp_path, CONFIG))
    assert sorted((camera.width, camera.height) for camera in cameras.values()) == [(240, 240), (320, 240)]
    assert len(images) == 4


def test_lenses_without_distortion_keep_their_size():
    for model, params in [
        ("PINHOLE", (50.0, 51.0, 32.0, 24.0)),
        ("SIMPLE_PINHOLE", (50.0, 32.0, 24.0)),
        ("OPENCV", (50.0, 51.0, 32.0, 24.0, 0.0, 0.0, 0.0, 0.0)),
        ("RADIAL", (50.0, 32.0, 24.0, 0.0, 0.0)),
    ]:
        intrinsics = Intrinsics(model, params, 64, 48)
        pinhole = undistorted(intrinsics)
        assert is_pinhole(intrinsics) and (pinhole.model, pinhole.width, pinhole.height) == ("PINHOLE", 64, 48)
        assert pinhole.params == (50, 51 if 51 in params else 50, 32, 24)
    assert not is_pinhole(Intrinsics("OPENCV_FISHEYE", (50.0, 51.0, 32.0, 24.0, 0.0, 0.0, 0.0, 0.0), 64, 48))


@pytest.mark.slow
@pytest.mark.shared
def test_a_real_facade_is_recovered(shared, tmp_path):
    """All photos of sceaux get a pose, which agrees with the poses of the scene."""
    for file in (shared / "data" / "sceaux" / "images").iterdir():
        with Image.open(file) as image:
            image.resize((480, 355), Image.Resampling.BOX).save(tmp_path / file.name, quality=95)
    found = load_scene(tmp_path, DataConfig(test_every=0)).train
    given = load_scene(shared / "data" / "sceaux", DataConfig(test_every=0)).train
    assert [view.name for view in found] == [view.name for view in given]
    one, other = (np.array([view.camera.position for view in views]) for views in (found, given))
    one, other = (points - points.mean(axis=0) for points in (one, other))
    correlation = np.linalg.svd(one.T @ other)[1].sum() / np.linalg.norm(one) / np.linalg.norm(other)
    assert correlation > 0.9999  # 1 for two point sets that differ by a similarity; 1 % of noise gives 0.99995


def test_a_record_leads_to_no_other_photos(copy, photos, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    Image.fromarray(photos[0]).save(outside / "private.png")
    path = copy / "sparse" / RECORD
    record = json.loads(path.read_text())
    for named in (str(outside), "../outside"):
        path.write_text(json.dumps({**record, "photos": named}))
        with pytest.raises(InputError, match=rf"{RECORD}: expected photos inside .* found other photos in .*outside"):
            load_scene(copy, DataConfig())
        with pytest.raises(InputError, match=rf"{RECORD}: expected photos inside"):
            dataset_lines(copy)


@pytest.mark.parametrize("name", FILES)
def test_a_model_that_the_disk_did_not_take_is_not_kept(copy, monkeypatch, name):
    """COLMAP ends well where a write fails, and later runs would find the damaged model."""
    shutil.move(copy / "sparse" / "0", copy.with_name("whole"))
    shutil.rmtree(copy / "sparse")

    def solved(work, *_):
        model = work / "sparse" / "0"
        shutil.copytree(copy.with_name("whole"), model)
        os.truncate(model / name, (model / name).stat().st_size // 2)
        return 4

    monkeypatch.setattr(reconstruction, "_solved", solved)
    with pytest.raises(InputError, match=r"cannot write the recovered cameras to .*: what was written is damaged"):
        reconstruct(copy, CONFIG)
    assert sorted(os.listdir(copy)) == [f"photo {k}.png" for k in range(4)]


def test_a_limit_of_the_size_of_files_is_named(copy):
    shutil.rmtree(copy / "sparse")
    with small_files(), pytest.raises(InputError, match=r"cannot write the recovered .*File too large; `ulimit -f`"):
        reconstruct(copy, CONFIG)
    assert not [name for name in os.listdir(copy) if name.startswith(WORK)]
