"""transforms.json in its dialects: known cameras are read, and impossible values are refused."""

import json

import numpy as np
import pytest
from PIL import Image

from clsplat.camera import Camera
from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.dataset.lenses import Intrinsics
from clsplat.dataset.transforms import read_dataset
from clsplat.errors import InputError

CAMERAS = [
    Camera.look_at(eye, (0, 0, 0), (0, 0, 1), 50, 64, 48) for eye in [(3, 0, 1), (0, 3, 1), (-3, 0, 1), (0, -3, 1)]
]
NAMES = ["images/0.png", "images/1.png", "images/2.png", "images/3.png"]


def opengl(camera):
    """Camera to world, x right, y up, z back."""
    return (np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])).tolist()


def frames(names=NAMES):
    return [{"file_path": n, "transform_matrix": opengl(c)} for n, c in zip(names, CAMERAS, strict=False)]


def write(root, name="transforms.json", names=NAMES, **fields):
    (root / name).write_text(json.dumps({"frames": frames(names), **fields}))


def write_photos(root, names=NAMES, size=(64, 48), mode="RGB"):
    for k, name in enumerate(names):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new(mode, size, (k, 100, 200, 0) if mode == "RGBA" else (k, 100, 200)).save(root / name)


def intrinsics_of(root, downscale=1):
    return read_dataset(root, DataConfig(downscale=downscale)).photos[0].intrinsics


def test_poses_become_opencv_world_to_camera(root):
    write(root, fl_x=50)
    scene = load_scene(root, DataConfig(test_every=0))
    assert [view.name for view in scene.train] == NAMES and not scene.test
    for view, camera in zip(scene.train, CAMERAS, strict=True):
        np.testing.assert_allclose(view.camera.viewmat, camera.viewmat, atol=1e-12)
        np.testing.assert_allclose(view.camera.position, camera.position, atol=1e-12)
        assert (view.camera.fx, view.camera.cx, view.camera.cy) == (50, 32, 24)
    assert scene.points.shape == (0, 3)


def test_transposed_matrices_are_refused(root):
    rows = [{**frame, "transform_matrix": np.transpose(frame["transform_matrix"]).tolist()} for frame in frames()]
    (root / "transforms.json").write_text(json.dumps({"frames": rows, "fl_x": 50}))
    with pytest.raises(
        InputError, match=r"expected 0, 0, 0, 1 in the last row of .* images/0.png, found .*transpose"
    ):
        read_dataset(root, DataConfig())


def test_matrices_of_three_rows_are_the_same(root):
    rows = [{**frame, "transform_matrix": frame["transform_matrix"][:3]} for frame in frames()]
    (root / "transforms.json").write_text(json.dumps({"frames": rows, "fl_x": 50}))
    np.testing.assert_allclose(read_dataset(root, DataConfig()).photos[1].viewmat, CAMERAS[1].viewmat, atol=1e-12)


def test_blender_angle_and_names_without_ending(tmp_path):
    names = ["train/r_0.png", "train/r_1.png", "test/r_0.png"]
    write_photos(tmp_path, names, mode="RGBA")
    angle = 2 * np.arctan(32 / 50)
    write(tmp_path, "transforms_train.json", ["./train/r_0", "./train/r_1"], camera_angle_x=angle)
    write(tmp_path, "transforms_test.json", ["./test/r_0"], camera_angle_x=angle)
    scene = load_scene(tmp_path, DataConfig(background="white", test_every=1))
    assert [view.name for view in scene.train] == names[:2] and [view.name for view in scene.test] == names[2:]
    np.testing.assert_allclose([scene.train[0].camera.fx, scene.train[0].camera.fy], 50)
    assert (scene.train[0].image == 255).all()  # transparent: the background


def test_the_number_of_a_frame_is_no_suffix(tmp_path):
    """Blender writes render.0001.png, and its file_path without .png."""
    names = [f"images/render.{k:04d}" for k in range(4)]
    write_photos(tmp_path, [f"{name}.png" for name in names] + ["masks/render.png"])
    write_photos(tmp_path, [f"{name}.png".replace("images", "masks") for name in names])
    write(tmp_path, names=names, fl_x=50)
    photos = read_dataset(tmp_path, DataConfig(masks="masks")).photos
    assert [photo.name for photo in photos] == [f"{name}.png" for name in names]
    assert [photo.mask for photo in photos] == [tmp_path / "masks" / f"render.{k:04d}.png" for k in range(4)]


def test_validation_photos_are_held_out_where_there_are_no_test_photos(tmp_path):
    names = ["train/0.png", "val/0.png", "test/0.png"]
    write_photos(tmp_path, names)
    for part in ("train", "val"):
        write(tmp_path, f"transforms_{part}.json", [f"{part}/0"], fl_x=50)
    assert [view.name for view in load_scene(tmp_path, DataConfig()).test] == ["val/0.png"]
    write(tmp_path, "transforms_test.json", ["test/0"], fl_x=50)
    assert [view.name for view in load_scene(tmp_path, DataConfig()).test] == ["test/0.png"]


def test_nerfstudios_split_is_kept(root):
    write(root, fl_x=50, train_filenames=NAMES[:2], val_filenames=NAMES[2:3], test_filenames=NAMES[3:])
    scene = load_scene(root, DataConfig())
    assert [view.name for view in scene.test] == NAMES[2:]


def test_names_in_nerfstudios_split_may_be_written_in_another_way(root):
    write(root, fl_x=50, test_filenames=["./images/2.png", "images\\3.png"], val_filenames=[], train_filenames=[])
    scene = load_scene(root, DataConfig())
    assert [view.name for view in scene.train] == NAMES[:2] and [view.name for view in scene.test] == NAMES[2:]


def test_a_list_of_photos_to_train_on_leaves_out_those_in_no_list(root):
    write(root, fl_x=50, train_filenames=[f"./{name}" for name in NAMES[:2]])
    with pytest.warns(UserWarning, match=r"transforms\.json: 2 of 4 photos are in none of the lists .*2\.png"):
        scene = load_scene(root, DataConfig())
    assert [view.name for view in scene.train] == NAMES[:2] and not scene.test
    write(root, fl_x=50, train_filenames=NAMES[:2], test_filenames=NAMES[3:])
    with pytest.warns(UserWarning, match=r"transforms\.json: 1 of 4 photos"):
        scene = load_scene(root, DataConfig())
    assert [view.name for view in scene.train] == NAMES[:2] and [view.name for view in scene.test] == NAMES[3:]


def test_frames_without_a_file_are_counted_in_one_warning(root):
    (root / NAMES[1]).unlink()
    (root / NAMES[2]).unlink()
    write(root, fl_x=50)
    with pytest.warns(UserWarning, match="2 of 4") as caught:
        dataset = read_dataset(root, DataConfig())
    assert len(caught) == 1 and [photo.name for photo in dataset.photos] == [NAMES[0], NAMES[3]]


def test_masks_of_frames_and_of_the_folder(root):
    write_photos(root, [f"masks/{k}.png" for k in range(4)])
    write(root, fl_x=50)
    masks = [photo.mask for photo in read_dataset(root, DataConfig(masks="masks")).photos]
    assert masks == [root / "masks" / f"{k}.png" for k in range(4)]
    rows = frames()
    rows[0]["mask_path"] = "masks/3.png"
    (root / "transforms.json").write_text(json.dumps({"frames": rows, "fl_x": 50}))
    assert [photo.mask for photo in read_dataset(root, DataConfig()).photos] == [
        root / "masks/3.png",
        None,
        None,
        None,
    ]


def bad_frame(**fields):
    rows = frames()
    rows[1] |= fields
    return {"frames": rows}


MIRRORED = (np.array(opengl(CAMERAS[1])) @ np.diag([-1, 1, 1, 1])).tolist()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"frames": []}, "frames"),
        ({"frames": {"a": 1}}, "frames"),
        ({"frames": ["a"]}, "file_path.*frame 0"),
        (bad_frame(file_path=None), "file_path.*frame 1"),
        (bad_frame(file_path="../1.png"), r"\.\./1\.png"),
        (bad_frame(file_path="/1.png"), r"/1\.png"),
        (bad_frame(transform_matrix=None), r"transform_matrix.*1\.png"),
        (bad_frame(transform_matrix=[[1, 2], [3]]), r"transform_matrix.*1\.png"),
        (bad_frame(transform_matrix=(np.eye(4) * np.nan).tolist()), r"transform_matrix.*1\.png"),
        (bad_frame(transform_matrix=MIRRORED), r"1\.png.*determinant -1"),
        (bad_frame(transform_matrix=np.diag([2, 2, 2, 1]).tolist()), r"1\.png.*determinant"),
        (bad_frame(fl_x="wide"), r"1\.png.*fl_x.*wide"),
        (bad_frame(fl_x=-3), r"1\.png.*fl_x"),
        (bad_frame(k1=float("nan")), r"1\.png.*k1"),
        (bad_frame(w=0), r"1\.png.*0x48"),
        (bad_frame(w=48, h=64), r"1\.png.*48x64.*64x48"),
        ({"fl_x": None}, "fl_x"),
        ({"camera_model": "PINBALL"}, "camera_model.*PINBALL"),
        ({"k4": 0.1}, "k4"),
        ({"test_filenames": ["1.png"]}, "test_filenames.*found none of them in"),
        ({"train_filenames": NAMES, "val_filenames": "images"}, "val_filenames.*found none of them in images"),
        ({"test_filenames": [3]}, "found 3"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "p1"),
        ({"ply_file_path": "../points.ply"}, r"\.\./points\.ply"),
    ],
)
def test_what_cannot_be_right_is_refused(root, fields, message):
    (root / "transforms.json").write_text(json.dumps({"frames": frames(), "fl_x": 50, **fields}))
    with pytest.raises(InputError, match=message):
        load_scene(root, DataConfig())


def test_neither_focal_length_nor_angle_is_an_error(root):
    write(root)
    with pytest.raises(InputError, match="fl_x or camera_angle_x"):
        load_scene(root, DataConfig())
    write(root, camera_angle_x=3.5)
    with pytest.raises(InputError, match="camera_angle_x between"):
        load_scene(root, DataConfig())


def test_null_is_the_same_as_missing(root):
    empty = {"mask_path": None, "k1": None, "fl_x": None, "camera_angle_x": None, "camera_model": None}
    rows = [frame | empty for frame in frames()]
    whole = {"fl_x": 50, "ply_file_path": None, "test_filenames": None, "is_fisheye": None}
    (root / "transforms.json").write_text(json.dumps({"frames": rows, **whole}))
    photos = read_dataset(root, DataConfig()).photos
    assert {photo.intrinsics for photo in photos} == {Intrinsics("PINHOLE", (50, 50, 32, 24), 64, 48)}
    assert {(photo.mask, photo.held_out) for photo in photos} == {(None, None)}


def test_a_byte_order_mark_is_skipped(root):
    """Windows' Notepad and PowerShell write it."""
    write(root, fl_x=50)
    path = root / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(read_dataset(root, DataConfig()).photos) == 4


@pytest.mark.parametrize("content", ["", "{", "[]", "\xff"])
def test_files_that_are_no_transforms_are_refused_by_name(root, content):
    (root / "transforms.json").write_text(content, encoding="latin-1")
    with pytest.raises(InputError, match=r"transforms\.json"):
        load_scene(root, DataConfig())


# ---- real scenes


@pytest.mark.shared
def test_lego_brings_its_split(shared):
    scene = load_scene(shared / "data" / "lego", DataConfig(background="white"))
    assert (len(scene.train), len(scene.test), len(scene.points)) == (100, 25, 0)
    camera = scene.train[0].camera
    assert scene.train[0].image.shape == (400, 400, 3)
    np.testing.assert_allclose(camera.fx, 200 / np.tan(0.6911112070083618 / 2))
    # The cameras stand on a sphere of radius 4.03 around the origin and look at it.
    for view in scene.train + scene.test:
        np.testing.assert_allclose(np.linalg.norm(view.camera.position), 4.03, atol=0.01)
        np.testing.assert_allclose(view.camera.viewmat[:2, 3], 0, atol=0.01)


@pytest.mark.shared
@pytest.mark.parametrize("downscale", [2, 4])
def test_fox_agrees_with_its_colmap_model(shared, tmp_path, downscale):
    """Two reconstructions of the same photos have the same cameras up to a similarity."""
    fox = shared / "data" / "fox"
    for name in ("images_2", "images_4", "transforms.json"):
        (tmp_path / name).symlink_to(fox / name)
    config = DataConfig(downscale=downscale, test_every=0)
    with pytest.warns(UserWarning, match="17 of 67"):
        theirs = load_scene(tmp_path, config).train
    ours = load_scene(fox, config).train
    assert [view.name for view in theirs] == [f"images/{view.name}" for view in ours] and len(ours) == 50
    source, target = (np.array([view.camera.position for view in views]) for views in (ours, theirs))
    source, target = source - source.mean(axis=0), target - target.mean(axis=0)
    u, s, vt = np.linalg.svd(target.T @ source)  # Umeyama 1991
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = u @ sign @ vt, np.trace(np.diag(s) @ sign) / (source**2).sum()
    error = np.linalg.norm(scale * source @ rotation.T - target, axis=1)
    # README of the data: 0.14 % of the extent and 0.76 degrees at most, from different principal points.
    assert np.sqrt(np.mean(error**2)) < 0.002 * np.linalg.norm(target, axis=1).max()
    for one, other in zip(ours, theirs, strict=True):
        relative = one.camera.viewmat[:3, :3] @ rotation.T @ other.camera.viewmat[:3, :3].T
        assert np.degrees(np.arccos((np.trace(relative) - 1) / 2)) < 1.0
    np.testing.assert_allclose(ours[0].camera.fx, theirs[0].camera.fx, rtol=0.001)
    np.testing.assert_allclose(ours[0].image.shape, theirs[0].image.shape, atol=4)


def test_whole_numbers_in_text_are_not_wrapped(root):
    """300 as uchar would be 44."""
    header = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    colours = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    (root / "points.ply").write_text(f"{header}{colours}end_header\n1 2 3 300 0 0\n")
    write(root, fl_x=50, ply_file_path="points.ply")
    with pytest.raises(InputError, match=r"points\.ply: expected red within uint8"):
        read_dataset(root, DataConfig())


@pytest.mark.parametrize(
    "change",
    [
        {"fl_x": 10**400},
        {"w": 1e300, "h": 7.5e299},
        {"transform_matrix": [[10**400] * 4] * 4},
        {"transform_matrix": [[1, 0, 0, 0], [1e308, -1, 0, 1e308], [0, 0, -1, 0], [0, 0, 0, 1]]},
    ],
    ids=["focal length", "size", "pose", "product of a pose"],
)
def test_values_that_broke_the_reader(root, change):
    """Found by fuzzing: TypeError, OverflowError, a NumPy warning, and lists of 1e300 pixels."""
    first, *others = frames()
    (root / "transforms.json").write_text(
        json.dumps({"frames": [first | {"fl_x": 50} | change, *others], "fl_x": 50})
    )
    with pytest.raises(InputError, match="transforms"):
        read_dataset(root, DataConfig())
