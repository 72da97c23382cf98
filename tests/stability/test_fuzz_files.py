"""Damaged files of every kind are read, or refused by an error that names the file, and take a bounded amount of
memory.

A file is written correctly. Then bytes are cut, flipped and spliced, and numbers are replaced by extreme ones, also
inside its compressed parts. `make fuzz-cases` runs the same tests with many more cases.
"""

import gzip
import io
import json
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from damage import ANY, BINARY, JSON_CHANGES, JSON_VALUES, TEXT, changed, damaged
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from readers import MEMORY_MAX, PHOTO_MEMORY_MAX
from test_colmap import write_bin, write_photos, write_txt
from test_loading import write_transforms

from clsplat.config import DataConfig, TrainConfig
from clsplat.dataset import colmap, load_scene, transforms
from clsplat.dataset.photos import orientation, photo_size, read_photo
from clsplat.errors import InputError
from clsplat.formats import FORMATS, load_gaussians, save_gaussians
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene
from clsplat.training.checkpoint import load_state, save_state
from clsplat.training.loop import initial_state


def read(load, name, memory=MEMORY_MAX):
    """Result of `load`, or None if it refuses the file by `name`. Everything else is a failure."""
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            # Ignore warnings for the user, and Pillow's on large images. NumPy's would reveal unchecked values.
            warnings.simplefilter("ignore", UserWarning)
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            return load()
    except InputError as error:
        assert name in str(error), f"the message does not name {name}: {error}"
        return None
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < memory, f"{peak} bytes"


def check_gaussians(path, content, cases):
    path.write_bytes(content)
    cases["files of Gaussians"] += 1
    found = read(lambda: load_gaussians(path), path.name)
    if found is not None:
        gaussians, mode, offset = found
        assert len(gaussians.validate()) > 0 and mode in ("classic", "antialiased")
        assert all(np.isfinite(array).all() for array in gaussians.arrays().values()) and np.isfinite(offset).all()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture(scope="module")
def originals(folder):
    """An undamaged file of each format, and an ASCII PLY."""
    scene = synthetic_scene(9, sh_degree=1)[0].astype(np.float32)
    files = {}
    for suffix in FORMATS:
        path = folder / f"whole{suffix}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            save_gaussians(path, scene, "antialiased")
        files[suffix] = path.read_bytes()
    from plyfile import PlyData

    text = PlyData.read(folder / "whole.ply")
    text.text = True
    text.write(folder / "text.ply")
    files["ascii"] = (folder / "text.ply").read_bytes()
    return files


@pytest.mark.parametrize("suffix", FORMATS)
def test_damaged_files_of_gaussians(folder, originals, cases, suffix):
    """Damage to the bytes of the file: headers, counts, compressed streams."""

    @given(ANY)
    def check(changes):
        check_gaussians(folder / f"damaged{suffix}", damaged(originals[suffix], changes), cases)

    check()


def test_damaged_text_ply(folder, originals, cases):
    @given(TEXT)
    def check(changes):
        check_gaussians(folder / "damaged.ply", damaged(originals["ascii"], changes), cases)

    check()


def test_damage_inside_spz(folder, originals, cases):
    plain = gzip.decompress(originals[".spz"])

    @given(BINARY)
    def check(changes):
        check_gaussians(folder / "inner.spz", gzip.compress(damaged(plain, changes), 1), cases)

    check()


def test_damage_inside_sog(folder, originals, cases):
    with zipfile.ZipFile(io.BytesIO(originals[".sog"])) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(parts["meta.json"])

    @given(JSON_CHANGES, st.sampled_from(["", *parts]), ANY)
    def check(edits, name, changes):
        edited = meta
        for place, new in edits:
            edited = changed(edited, place, new)
        files = {**parts, "meta.json": json.dumps(edited).encode()}
        if name:
            files[name] = damaged(files[name], changes)
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            for entry, content in files.items():
                archive.writestr(entry, content)
        check_gaussians(folder / "inner.sog", file.getvalue(), cases)

    check()


@pytest.mark.parametrize("ending", ["bin", "txt"])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_damaged_colmap_models(folder, cases, ending, name):
    model = folder / f"{ending}-{name}"
    {"bin": write_bin, "txt": write_txt}[ending](model)
    path = model / f"{name}.{ending}"
    whole = path.read_bytes()

    @given(TEXT if ending == "txt" else ANY)
    def check(changes):
        path.write_bytes(damaged(whole, changes))
        cases["COLMAP models"] += 1
        # The error on a missing camera comes from the photos, and names both files.
        found = read(lambda: colmap.read_model(model), f"{model.name}/")
        if found is not None:
            _, images, points, *_ = found
            assert images and np.isfinite(points).all()
            for _, _, viewmat in images:
                rotation = viewmat[:3, :3]
                assert np.isfinite(viewmat).all()
                np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)

    check()


NAMES = st.one_of(
    st.sampled_from([v for v in JSON_VALUES if isinstance(v, str)]),
    st.lists(
        st.sampled_from(["..", ".", "a", "a.png", "/", "\\", "C:", "~", " ", "images", "%2e%2e"]), max_size=5
    ).map("/".join),
    st.text(max_size=20),
)


@pytest.mark.parametrize("kind", ["bin", "txt", "transforms"])
def test_names_of_photos_stay_in_the_folder(folder, cases, kind):
    """Files outside of the dataset are not read, regardless of the path."""
    outside = folder / kind
    root = outside / "inner" / "data"
    photos = [("a.png", 1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0))]
    for place in (root / "images", root / "images" / "a", root, outside, outside / "inner"):
        write_photos(place, photos)

    @given(NAMES)
    def check(name):
        cases["names of photos"] += 1
        if kind == "transforms":
            (root / "transforms.json").write_text(
                json.dumps({"fl_x": 20, "frames": [{"file_path": name, "transform_matrix": np.eye(4).tolist()}]})
            )
            found = read(lambda: transforms.read_dataset(root, DataConfig()), root.name)
        else:
            rows = [(name.encode("utf-8", "ignore").decode(), *photos[0][1:])]
            {"bin": write_bin, "txt": write_txt}[kind](root / "sparse", images=rows)
            found = read(lambda: colmap.read_dataset(root, root / "sparse", DataConfig()), root.name)
        for photo in found.photos if found is not None else ():
            assert photo.path.resolve().is_relative_to(root.resolve()), photo.path

    check()


def test_damaged_transforms(folder, cases):
    """Arbitrary values at arbitrary positions of the JSON, and damage to its text."""
    root = folder / "transforms"
    write_transforms(root, ["images/a.png", "images/b.png"])
    path = root / "transforms.json"
    meta = json.loads(path.read_text())
    extra = {"w": 16, "h": 12, "fl_y": 20.0, "cx": 8, "cy": 6, "k1": 0.01, "camera_model": "OPENCV"}
    meta |= extra | {"ply_file_path": "points.ply", "test_filenames": ["images/a.png"]}
    meta["frames"][0]["mask_path"] = "images/a.png"
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    (root / "points.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{axes}end_header\n1 2 3\n")

    @given(JSON_CHANGES, st.one_of(st.just([]), TEXT))
    def check(edits, changes):
        edited = meta
        for place, new in edits:
            edited = changed(edited, place, new)
        path.write_bytes(damaged(json.dumps(edited).encode(), changes))
        cases["transforms.json"] += 1
        found = read(lambda: load_scene(root, DataConfig(test_every=0)), "")
        if found is not None:
            assert all(np.isfinite(view.camera.viewmat).all() for view in found.train)

    check()


@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_damaged_points_of_transforms(folder, originals, cases, kind):
    root = folder / f"points-{kind}"
    write_transforms(root, ["images/a.png"])
    meta = json.loads((root / "transforms.json").read_text()) | {"ply_file_path": "points.ply"}
    (root / "transforms.json").write_text(json.dumps(meta))

    @given(TEXT)
    def check(changes):
        (root / "points.ply").write_bytes(damaged(originals["ascii" if kind == "ascii" else ".ply"], changes))
        cases["points of transforms.json"] += 1
        found = read(lambda: transforms.read_dataset(root, DataConfig()), "points.ply")
        assert found is None or np.isfinite(found.points).all()

    check()


IMAGES = {"png": "PNG", "jpg": "JPEG", "webp": "WEBP", "tif": "TIFF", "bmp": "BMP"}


@pytest.mark.parametrize("ending", IMAGES)
def test_damaged_photos(folder, cases, ending):
    path = folder / f"photo.{ending}"
    pixels = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(path, format=IMAGES[ending], **({} if ending == "bmp" else {"exif": exif}))
    whole = path.read_bytes()

    @given(BINARY)
    def check(changes):
        path.write_bytes(damaged(whole, changes))
        cases["photos"] += 1
        size = read(lambda: photo_size(path), path.name)
        turned = read(lambda: orientation(path), path.name)
        photo = read(lambda: read_photo(path, (0.0, 0.0, 0.0), upright=True), path.name, PHOTO_MEMORY_MAX)
        assert turned in (None, *range(1, 9)) and (size is None or min(size) >= 0)
        assert photo is None or (photo.dtype == np.uint8 and photo.ndim == 3 and photo.shape[2] == 3)

    check()


def test_damaged_checkpoints(folder, cases):
    """Damage to the bytes of the file and of its arrays, whose headers determine the size of the memory."""
    _, camera = synthetic_scene(1)
    photo = np.zeros((camera.height, camera.width, 3), np.uint8)
    scene = Scene(
        [View("a", camera, photo)], [], np.random.default_rng(0).normal(size=(9, 3)), np.zeros((9, 3), np.uint8)
    )
    config = TrainConfig()
    path = folder / "checkpoint.npz"
    save_state(path, initial_state(scene, config), config)
    whole = path.read_bytes()
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}

    @given(st.sampled_from(["", *parts]), ANY, st.sampled_from(["", *parts]))
    def check(name, changes, removed):
        content = damaged(whole, changes)
        if name:
            file = io.BytesIO()
            with zipfile.ZipFile(file, "w") as archive:
                for entry, inner in parts.items():
                    if entry != removed:
                        archive.writestr(entry, damaged(inner, changes) if entry == name else inner)
            content = file.getvalue()
        path.write_bytes(content)
        cases["checkpoints"] += 1
        found = read(lambda: load_state(path, 1.0, config), path.name)
        if found is not None:
            n = len(found.gaussians.validate())
            assert {len(found.moments.first.validate()), len(found.moments.second.validate())} == {n} and n > 0

    check()


def each_flaw(content):
    """Yield every cut and every flipped bit of a file, or an even selection as large as the profile's number of
    cases."""
    total = 9 * len(content)
    for at in range(0, total, max(1, total // settings.default.max_examples)):
        place, bit = divmod(at, 9)
        yield damaged(content, [("cut", place) if bit == 8 else ("flip", place, bit)])


@pytest.mark.parametrize("kind", [*FORMATS, "ascii"])
def test_every_cut_and_every_bit_of_files_of_gaussians(folder, originals, cases, kind):
    for content in each_flaw(originals[kind]):
        check_gaussians(folder / ("each.ply" if kind == "ascii" else f"each{kind}"), content, cases)


@pytest.mark.parametrize("ending", ["bin", "txt"])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_every_cut_and_every_bit_of_colmap_models(folder, cases, ending, name):
    model = folder / f"each-{ending}-{name}"
    {"bin": write_bin, "txt": write_txt}[ending](model)
    path = model / f"{name}.{ending}"
    for content in each_flaw(path.read_bytes()):
        path.write_bytes(content)
        cases["COLMAP models"] += 1
        read(lambda: colmap.read_model(model), f"{model.name}/")


@pytest.mark.parametrize("ending", IMAGES)
def test_every_cut_and_every_bit_of_photos(folder, cases, ending):
    path = folder / f"each.{ending}"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)).save(path)
    for content in each_flaw(path.read_bytes()):
        path.write_bytes(content)
        cases["photos"] += 1
        read(lambda: read_photo(path, (0.0, 0.0, 0.0), upright=True), path.name, PHOTO_MEMORY_MAX)


def test_every_cut_and_every_bit_of_transforms(folder, cases):
    root = folder / "each"
    write_transforms(root, ["images/a.png"])
    path = root / "transforms.json"
    for content in each_flaw(path.read_bytes()):
        path.write_bytes(content)
        cases["transforms.json"] += 1
        read(lambda: transforms.read_dataset(root, DataConfig()), root.name)
