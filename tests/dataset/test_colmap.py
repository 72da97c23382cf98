"""COLMAP models: our parser agrees with pycolmap's on real models and rejects damage of every kind."""

import struct

import numpy as np
import pytest
from PIL import Image

from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.dataset.colmap import FOLDERS, MODELS, find_model, read_dataset, read_model
from clsplat.dataset.finding import PhotosMissing
from clsplat.dataset.lenses import Intrinsics
from clsplat.errors import InputError

CAMERAS = [(1, "PINHOLE", 64, 48, (50.0, 60.0, 32.0, 24.0)), (7, "SIMPLE_RADIAL", 40, 30, (45.0, 20.0, 15.0, 0.0))]
S = 0.5**0.5
# name, camera, quaternion wxyz, translation
IMAGES = [
    ("a.png", 1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0)),
    ("right hand/b.png", 7, (S, 0.0, S, 0.0), (1.0, 2.0, 3.0)),
    ("c.png", 1, (0.0, 3.0, 0.0, 0.0), (0.5, 0.0, 2.0)),
]
POINTS = [((0.0, 1.0, 2.0), (1, 2, 255)), ((-3.5, 1e-3, 4.0), (0, 128, 7))]


def write_bin(folder, cameras=CAMERAS, images=IMAGES, points=POINTS):
    folder.mkdir(parents=True, exist_ok=True)
    numbers = {name: number for number, (name, _) in enumerate(MODELS)}
    parts = [struct.pack("<Q", len(cameras))]
    for number, model, width, height, params in cameras:
        parts.append(struct.pack(f"<IiQQ{len(params)}d", number, numbers[model], width, height, *params))
    (folder / "cameras.bin").write_bytes(b"".join(parts))
    parts = [struct.pack("<Q", len(images))]
    for number, (name, camera, quat, translation) in enumerate(images, 1):
        parts.append(struct.pack("<I7dI", number, *quat, *translation, camera) + name.encode() + b"\0")
        parts.append(struct.pack("<Q", number) + struct.pack("<ddq", 1, 2, -1) * number)
    (folder / "images.bin").write_bytes(b"".join(parts))
    parts = [struct.pack("<Q", len(points))]
    for number, (xyz, rgb) in enumerate(points, 1):
        parts.append(struct.pack("<Q3d3Bd", number, *xyz, *rgb, 0.5))
        parts.append(struct.pack("<Q", number) + struct.pack("<II", 1, 0) * number)
    (folder / "points3D.bin").write_bytes(b"".join(parts))


def write_txt(folder, cameras=CAMERAS, images=IMAGES, points=POINTS):
    folder.mkdir(parents=True, exist_ok=True)

    def line(*values):
        return " ".join(map(str, values)) + "\n"

    text = "# a comment\n" + "".join(line(n, model, w, h, *params) for n, model, w, h, params in cameras)
    (folder / "cameras.txt").write_text(text)
    rows = [
        line(n, *q, *t, c, name) + ("\n" if n == 1 else "1 2 -1\n") for n, (name, c, q, t) in enumerate(images, 1)
    ]
    (folder / "images.txt").write_text("# a comment\n" + "".join(rows))
    text = "# a comment\n" + "".join(line(n, *xyz, *rgb, 0.5, 1, 0) for n, (xyz, rgb) in enumerate(points, 1))
    (folder / "points3D.txt").write_text(text)


WRITERS = {"bin": write_bin, "txt": write_txt}


def write_photos(folder, images=IMAGES):
    sizes = {number: (width, height) for number, _, width, height, _ in CAMERAS}
    for index, (name, camera, _, _) in enumerate(images):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", sizes[camera], (index, 100, 200)).save(folder / name)


@pytest.fixture(params=["bin", "txt"])
def ending(request):
    """Both encodings of a model."""
    return request.param


def test_both_encodings_say_the_same(tmp_path, ending):
    WRITERS[ending](tmp_path)
    cameras, images, points, colors, shown = read_model(tmp_path)
    assert cameras == {number: Intrinsics(model, params, w, h) for number, model, w, h, params in CAMERAS}
    assert [(name, camera) for name, camera, _ in images] == [(name, camera) for name, camera, _, _ in IMAGES]
    np.testing.assert_allclose(images[0][2], np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]))
    # A quarter turn about y takes z to x and x to -z.
    np.testing.assert_allclose(images[1][2], [[0, 0, 1, 1], [0, 1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(images[2][2][:3, :3], np.diag([1, -1, -1]))  # half a turn about x, norm 3
    np.testing.assert_array_equal(points, [xyz for xyz, _ in POINTS])
    np.testing.assert_array_equal(colors, [rgb for _, rgb in POINTS])
    assert colors.dtype == np.uint8
    assert {name: rows.tolist() for name, rows in shown.items()} == {"a.png": [0, 1]}


def test_photos_without_points_and_unknown_photos_show_none(tmp_path, ending):
    """Tracks may have numbers of photos that the model lacks: they are left out."""
    WRITERS[ending](tmp_path)
    if ending == "bin":
        one = struct.pack("<Q3d3Bd", 1, 0, 0, 0, 1, 2, 3, 0.5) + struct.pack("<Q8I", 4, 3, 0, 99, 5, 1, 2, 3, 7)
        (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 1) + one)
    else:
        (tmp_path / "points3D.txt").write_text("1 0 0 0 1 2 3 0.5 3 0 99 5 1 2 3 7\n")
    shown = read_model(tmp_path).shown
    assert {name: rows.tolist() for name, rows in shown.items()} == {"a.png": [0], "c.png": [0]}


def test_a_byte_order_mark_is_skipped(tmp_path):
    """Also before a first line that is no comment."""
    write_txt(tmp_path)
    for path in tmp_path.glob("*.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().removeprefix(b"# a comment\n"))
    cameras, images, points, *_ = read_model(tmp_path)
    assert (len(cameras), len(images), len(points)) == (2, 3, 2)


@pytest.mark.parametrize("folder", FOLDERS)
@pytest.mark.parametrize("photos", ["images", "."])
def test_models_and_photos_are_found_where_they_may_be(tmp_path, folder, photos, ending):
    WRITERS[ending](tmp_path / folder)
    write_photos(tmp_path / photos)
    assert find_model(tmp_path) == tmp_path / folder
    scene = load_scene(tmp_path, DataConfig(test_every=3))
    assert [view.name for view in scene.train] == ["c.png", "right hand/b.png"]
    assert [view.name for view in scene.test] == ["a.png"]
    assert [view.image[0, 0, 0] for view in scene.train] == [2, 1]
    assert scene.train[1].camera.fx == 45 and scene.train[1].image.shape == (30, 40, 3)
    np.testing.assert_array_equal(scene.points, [xyz for xyz, _ in POINTS])
    np.testing.assert_array_equal(scene.offset, 0)


def test_the_model_table_is_colmaps():
    import pycolmap

    for number, (name, params) in enumerate(MODELS):
        assert int(pycolmap.CameraModelId.__members__[name]) == number
        assert len(pycolmap.Camera.create_from_model_name(1, name, 50.0, 64, 48).params) == params


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_file_cut_off_anywhere_is_refused_by_name(tmp_path, name):
    write_bin(tmp_path)
    path = tmp_path / f"{name}.bin"
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=rf"{name}\.bin"):
            read_model(tmp_path)
    path.write_bytes(data + b"\0")
    with pytest.raises(InputError, match=rf"{name}\.bin"):
        read_model(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("count", [4, 10**9, 2**64 - 1])
def test_counts_beyond_the_file_are_refused_before_they_are_believed(tmp_path, name, count):
    write_bin(tmp_path)
    path = tmp_path / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    with pytest.raises(InputError, match=rf"{name}\.bin"):
        read_model(tmp_path)


def changed(rows, index, *values):
    """A copy of `rows` whose row `index` ends with `values`."""
    row = rows[index]
    return [*rows[:index], (*row[: len(row) - len(values)], *values), *rows[index + 1 :]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": changed(IMAGES, 1, (np.nan, 0, 0, 0), (0, 0, 0))}, r"images.*right hand/b\.png"),
        ({"images": changed(IMAGES, 1, (0.0, 0.0, 0.0, 0.0), (0, 0, 0))}, r"images.*right hand/b\.png"),
        ({"images": changed(IMAGES, 2, (np.inf, 0, 0))}, r"images.*c\.png"),
        ({"images": changed(IMAGES, 0, 9, (1, 0, 0, 0), (0, 0, 0))}, r"images.*camera 9.*a\.png"),
        ({"images": changed(IMAGES, 0, "../a.png", *IMAGES[0][1:])}, r"images.*\.\./a\.png"),
        ({"images": changed(IMAGES, 0, "/a.png", *IMAGES[0][1:])}, r"images.*/a\.png"),
        ({"images": []}, r"images.*at least one"),
        ({"cameras": changed(CAMERAS, 0, (50.0, np.nan, 32.0, 24.0))}, r"cameras.*camera 1"),
        ({"cameras": changed(CAMERAS, 0, 0, 48, CAMERAS[0][-1])}, r"cameras.*0x48"),
        ({"cameras": [*CAMERAS, CAMERAS[0]]}, r"cameras.*expected one camera of number 1, found two"),
        ({"cameras": changed(CAMERAS, 0, 2**40, 48, CAMERAS[0][-1])}, r"cameras.*x48"),
        ({"points": changed(POINTS, 1, (np.nan, 0, 0), (0, 0, 0))}, "points3D.*finite"),
        ({"points": changed(POINTS, 1, (np.inf, 0, 0), (0, 0, 0))}, "points3D.*finite"),
    ],
)
def test_bad_values_are_refused_with_file_and_photo(tmp_path, ending, change, message):
    WRITERS[ending](tmp_path, **change)
    with pytest.raises(InputError, match=message):
        read_model(tmp_path)


def test_quaternions_of_any_length_are_directions(tmp_path, ending):
    """The squares of 1e200 overflow, which once silently turned the rotation into NaN."""
    WRITERS[ending](tmp_path / "plain")
    WRITERS[ending](tmp_path / "long", images=changed(IMAGES, 1, (1e200, 0.0, 1e200, 0.0), IMAGES[1][3]))
    plain, long = (read_model(tmp_path / name)[1][1][2] for name in ("plain", "long"))
    np.testing.assert_allclose(long, plain, atol=1e-15)


def test_a_name_longer_than_files_have_is_a_missing_photo(tmp_path):
    write_txt(tmp_path / "sparse", images=changed(IMAGES, 0, "x" * 300, *IMAGES[0][1:]))
    write_photos(tmp_path / "images", IMAGES[1:])
    with pytest.warns(UserWarning, match="1 of 3 photos have no file"):
        assert len(read_dataset(tmp_path, tmp_path / "sparse", DataConfig()).photos) == 2


def test_unknown_camera_models_are_refused(tmp_path):
    write_bin(tmp_path)
    path = tmp_path / "cameras.bin"
    for number in (-1, len(MODELS), 2**31 - 1):
        path.write_bytes(struct.pack("<QIiQQ", 1, 1, number, 64, 48) + bytes(32))
        with pytest.raises(InputError, match=r"cameras\.bin.*camera models"):
            read_model(tmp_path)


@pytest.mark.parametrize(
    ("name", "line", "message"),
    [
        ("cameras", "1 PINBALL 64 48 50 50", r"cameras\.txt, line 4.*PINHOLE"),
        ("cameras", "1 PINHOLE 64 48 50 50", r"cameras\.txt, line 4.*4 parameters"),
        ("cameras", "1 PINHOLE", r"cameras\.txt, line 4"),
        ("images", "1 1 0 0 0 0 0", r"images\.txt, line 8.*QW"),
        ("points3D", "1 2 3", r"points3D\.txt, line 4.*X Y Z"),
        ("points3D", "1 0 0 0 300 0 0 1", r"points3D\.txt"),
        ("points3D", f"1 0 0 0 {10**400} 0 0 1", r"points3D\.txt, line 4"),
    ],
)
def test_bad_lines_are_refused_with_their_number(tmp_path, name, line, message):
    write_txt(tmp_path)
    with (tmp_path / f"{name}.txt").open("a") as file:
        file.write(line + "\n")
    with pytest.raises(InputError, match=message):
        read_model(tmp_path)


@pytest.mark.parametrize("name", ["images", "points3D"])
def test_missing_files_are_named(tmp_path, name, ending):
    WRITERS[ending](tmp_path)
    (tmp_path / f"{name}.{ending}").unlink()
    with pytest.raises(InputError, match=rf"{name}\.bin"):
        read_model(tmp_path)


def test_a_model_without_points_has_none(tmp_path, ending):
    WRITERS[ending](tmp_path, points=[])
    model = read_model(tmp_path)
    assert model.points.shape == model.colors.shape == (0, 3) and not model.shown


def test_photos_without_a_file_are_counted_in_one_warning(tmp_path):
    write_bin(tmp_path / "sparse/0")
    write_photos(tmp_path / "images", IMAGES[:1])
    with pytest.warns(UserWarning, match="2 of 3") as caught:
        dataset = read_dataset(tmp_path, tmp_path / "sparse/0", DataConfig())
    assert len(caught) == 1 and [photo.name for photo in dataset.photos] == ["a.png"]


def test_no_photos_at_all_is_an_error(tmp_path):
    write_bin(tmp_path / "sparse/0")
    with pytest.raises(PhotosMissing, match=r"images/a\.png"):
        read_dataset(tmp_path, tmp_path / "sparse/0", DataConfig())


def test_masks_belong_to_photos_by_name(tmp_path):
    write_bin(tmp_path / "sparse/0")
    write_photos(tmp_path / "images")
    write_photos(tmp_path / "masks")
    dataset = read_dataset(tmp_path, tmp_path / "sparse/0", DataConfig(masks="masks"))
    assert [photo.mask for photo in dataset.photos] == [tmp_path / "masks" / name for name, *_ in IMAGES]
    (tmp_path / "masks" / "c.png").unlink()
    with pytest.raises(InputError, match=r"masks/c\.png"):
        read_dataset(tmp_path, tmp_path / "sparse/0", DataConfig(masks="masks"))


# ---- real models


@pytest.mark.shared
@pytest.mark.parametrize("name", ["sceaux", "fox"])
def test_our_parser_agrees_with_colmaps(shared, tmp_path, name, ending):
    import pycolmap

    model = shared / "data" / name / "sparse" / "0"
    theirs = pycolmap.Reconstruction(model)
    if ending == "txt":
        theirs.write_text(tmp_path)
        model = tmp_path
    cameras, images, points, colors, shown = read_model(model)
    for number, camera in theirs.cameras.items():
        ours = cameras[number]
        assert (ours.model, ours.width, ours.height) == (camera.model.name, camera.width, camera.height)
        np.testing.assert_allclose(ours.params, camera.params, rtol=1e-15)  # text has 17 digits
    poses = {image.name: (image.camera_id, image.cam_from_world().matrix()) for image in theirs.images.values()}
    assert {image_name for image_name, _, _ in images} == set(poses)
    for image_name, camera_id, viewmat in images:
        assert camera_id == poses[image_name][0]
        np.testing.assert_allclose(viewmat[:3], poses[image_name][1], atol=1e-12)
    # The order is arbitrary and some points coincide: compare sorted rows of position and colour.
    ours = sorted(np.hstack([points, colors]).tolist())
    rows = sorted([*point.xyz.tolist(), *point.color.tolist()] for point in theirs.points3D.values())
    np.testing.assert_allclose(ours, rows, rtol=1e-14)
    for image in theirs.images.values():
        seen = [theirs.points3D[p.point3D_id].xyz for p in image.points2D if p.has_point3D()]
        np.testing.assert_allclose(
            np.unique(points[shown[image.name]], axis=0), np.unique(np.array(seen), axis=0), rtol=1e-14
        )


def sampled(image, pixels):
    """Colours, (N, 3), between pixel centres."""
    from scipy.ndimage import map_coordinates

    at = pixels[:, ::-1].T - 0.5
    return np.stack([map_coordinates(image[..., k].astype(float), at, order=1) for k in range(3)], axis=-1)


@pytest.mark.shared
@pytest.mark.parametrize(("name", "downscale"), [("fox", 2), ("fox", 4), ("sceaux", 1)])
def test_points_land_on_their_colours(shared, name, downscale):
    """Points project to places of our view that have the colours of their keypoints in the photo."""
    import pycolmap

    folder = shared / "data" / name
    theirs = pycolmap.Reconstruction(folder / "sparse" / "0")
    scene = load_scene(folder, DataConfig(downscale=downscale, test_every=0))
    views = {view.name: view for view in scene.train}
    photos = folder / (f"images_{downscale}" if downscale > 1 else "images")
    there, shifted = [], []
    for image in list(theirs.images.values())[::7]:
        view = views[image.name]
        seen = [point for point in image.points2D if point.has_point3D()]
        xyz = np.array([theirs.points3D[point.point3D_id].xyz for point in seen])
        local = xyz @ view.camera.viewmat[:3, :3].T + view.camera.viewmat[:3, 3]
        pixels = (local @ view.camera.K.T)[:, :2] / local[:, 2:]
        inside = ((pixels > 4) & (pixels < [view.camera.width - 4, view.camera.height - 4])).all(axis=1)
        photo = np.asarray(Image.open(photos / image.name))
        camera = theirs.cameras[image.camera_id]
        keypoints = np.array([point.xy for point in seen]) * (
            photo.shape[1] / camera.width,
            photo.shape[0] / camera.height,
        )
        colors = sampled(photo, keypoints[inside])
        there.append(np.abs(sampled(view.image, pixels[inside]) - colors))
        shifted.append(np.abs(sampled(view.image, pixels[inside] + (2, 0)) - colors))
    # At keypoints, which lie on edges, reprojection errors of half a pixel change colours by a few levels; an offset
    # of 2 pixels changes them by several times that.
    there, shifted = np.median(np.concatenate(there)), np.median(np.concatenate(shifted))
    assert there < 4 and shifted > 2.5 * there
