"""Depth maps: files of all kinds, the pixels of their photos, and their scales by the points that the photos see."""

import io
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from clsplat.camera import Camera
from clsplat.config import DataConfig
from clsplat.dataset.decoding import Dataset, PosedPhoto, load_view
from clsplat.dataset.depth_maps import POINTS_MIN, aligned, find_depth_map, load_depth_map, read_depth_map
from clsplat.dataset.lenses import Intrinsics
from clsplat.errors import InputError
from clsplat.scene import DepthMap, Scene, View
from clsplat.training.coarse_to_fine import shrunk

DEPTHS = np.array([[1, 2, 0], [400, 5, 65535]], np.uint16)
KNOWN = np.where(DEPTHS, DEPTHS, np.nan).astype(np.float32)


def saved(path: Path, array: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, array)
    else:
        Image.fromarray(array).save(path)
    return path


# ---- files


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.png", "u2"),
        ("a.tiff", "u2"),
        ("a.tif", "f4"),
        *(("a.npy", kind) for kind in ("f2", "f4", "f8", "u2", "i8")),
    ],
)
def test_files_of_all_kinds(tmp_path: Path, name: str, kind: str) -> None:
    depths = np.where(DEPTHS == 65535, 50, DEPTHS) if kind == "f2" else DEPTHS
    found = read_depth_map(saved(tmp_path / name, depths.astype(kind)))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.where(KNOWN == 65535, 50, KNOWN) if kind == "f2" else KNOWN)


def test_what_is_not_finite_is_unknown(tmp_path: Path) -> None:
    depths = np.array([[1.5, np.nan, np.inf], [-2, 0, 1e300]])
    found = read_depth_map(saved(tmp_path / "a.npy", depths))
    np.testing.assert_array_equal(found, np.float32([[1.5, np.nan, np.nan], [-2, np.nan, np.nan]]))


def archive() -> bytes:
    file = io.BytesIO()
    np.savez(file, a=DEPTHS)
    return file.getvalue()


def cut() -> bytes:
    file = io.BytesIO()
    np.save(file, np.ones((100, 100)), allow_pickle=False)
    return file.getvalue()[:-1]


WRONG: dict[str, tuple[str, Callable[[Path], Any], str]] = {
    "8 bits": ("a.png", lambda p: saved(p, DEPTHS.astype(np.uint8)), "16 bits or floats, found mode L"),
    "colours": ("a.png", lambda p: saved(p, np.zeros((2, 3, 3), np.uint8)), "one channel .* found mode RGB"),
    "no picture": ("a.png", lambda p: p.write_bytes(b"depth"), "cannot read"),
    "channels": (
        "a.npy",
        lambda p: saved(p, np.ones((2, 3, 1))),
        r"\(height, width\), found float64 of shape \(2, 3, 1\)",
    ),
    "no numbers": ("a.npy", lambda p: saved(p, np.array([["a"]])), "found <U1"),
    "booleans": ("a.npy", lambda p: saved(p, np.ones((2, 2), bool)), "found bool"),
    "objects": ("a.npy", lambda p: saved(p, np.array([[{}]])), "cannot read"),
    "an archive": ("a.npy", lambda p: p.write_bytes(archive()), "cannot read"),
    "cut off": ("a.npy", lambda p: p.write_bytes(cut()), "cannot read"),
    "empty file": ("a.npy", lambda p: p.write_bytes(b""), "cannot read"),
    "no pixels": ("a.npy", lambda p: saved(p, np.zeros((0, 3))), "found float64 of shape"),
    "nothing known": ("a.npy", lambda p: saved(p, np.array([[0, np.nan]])), "found only 0"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_files_that_are_no_depth_maps_are_refused_by_name(tmp_path: Path, wrong: str) -> None:
    name, write, found = WRONG[wrong]
    write(tmp_path / name)
    with pytest.raises(InputError, match=found) as error:
        read_depth_map(tmp_path / name)
    assert str(tmp_path / name) in str(error.value)


def test_maps_are_found_by_the_names_of_photos(tmp_path: Path) -> None:
    for name in ("a.png", "s/b.jpg.npy", "c.tiff", "d.tif", "d.npy", "render.png", "render.0001.npy"):
        saved(tmp_path / name, np.ones((2, 2), np.float32 if "png" not in name else np.uint16))
    for photo, name in {
        "a.jpg": "a.png",
        "images/a.jpg": "a.png",
        "s/b.jpg": "s/b.jpg.npy",
        "c.png": "c.tiff",
        "render.0001": "render.0001.npy",
    }.items():
        assert find_depth_map(tmp_path, photo) == tmp_path / name
    assert find_depth_map(tmp_path, "d.jpg") == tmp_path / "d.npy"
    with pytest.raises(InputError, match=r"cannot find the depth map of photo e\.jpg: neither .*e\.png"):
        find_depth_map(tmp_path, "e.jpg")


# ---- pixels


def photo_of_ramps(path: Path, intrinsics: Intrinsics) -> PosedPhoto:
    """A photo whose red is its column and whose green is its row, times 2."""
    rows, columns = np.mgrid[: intrinsics.height, : intrinsics.width]
    Image.fromarray(np.stack([2 * columns, 2 * rows, 0 * rows], axis=2).astype(np.uint8)).save(path / "a.png")
    return PosedPhoto("a.png", path / "a.png", np.eye(4), intrinsics)


@pytest.mark.parametrize("reduce", [1, 2])
@pytest.mark.parametrize("distorted", [False, True])
def test_maps_take_the_pixels_of_their_photos(tmp_path: Path, reduce: int, distorted: bool) -> None:
    """Undistorted and reduced alike: a map of columns and one of rows are the photo's red and green."""
    lens = (
        ("OPENCV", (60.0, 60.0, 48.0, 32.0, -0.2, 0.05, 0.0, 0.0)) if distorted else ("PINHOLE", (60.0, 60, 48, 32))
    )
    photo = photo_of_ramps(tmp_path, Intrinsics(*lens, 96, 64))
    dataset = Dataset([photo], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), reduce)
    view = load_view(photo, dataset, DataConfig())
    for channel, ramp in enumerate(np.mgrid[:64, :96][::-1]):
        saved(tmp_path / "m.npy", ramp + 1.0)
        depth = load_depth_map(tmp_path / "m.npy", photo, dataset)
        assert depth.values.shape == view.image.shape[:2]
        # Nearest neighbour, against the mean of a square: off by half a pixel each.
        assert np.abs(2 * (depth.values - 1) - view.image[:, :, channel].astype(float)).max() <= 1 + reduce


def test_smaller_and_larger_maps(tmp_path: Path) -> None:
    photo = photo_of_ramps(tmp_path, Intrinsics("PINHOLE", (60.0, 60, 48, 32), 96, 64))
    dataset = Dataset([photo], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    small = np.arange(1.0, 7).reshape(2, 3)
    found = load_depth_map(saved(tmp_path / "s.npy", small), photo, dataset)
    np.testing.assert_array_equal(found.values, np.kron(small, np.ones((32, 32))))
    large = np.kron(np.arange(1.0, 96 * 64 + 1).reshape(64, 96), np.ones((3, 3)))
    found = load_depth_map(saved(tmp_path / "l.npy", large), photo, dataset)
    np.testing.assert_array_equal(found.values, large[1::3, 1::3])


def test_a_map_is_turned_as_its_photo(tmp_path: Path) -> None:
    photo = photo_of_ramps(tmp_path, Intrinsics("PINHOLE", (60.0, 60, 48, 32), 96, 64))
    dataset = Dataset([photo], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), upright=True)
    exif, values = Image.Exif(), np.arange(1, 96 * 64 + 1, dtype=np.uint16).reshape(96, 64)
    exif[0x0112] = 6
    Image.fromarray(values).save(tmp_path / "m.png", exif=exif)
    found = load_depth_map(tmp_path / "m.png", photo, dataset)
    np.testing.assert_array_equal(found.values, values.T[:, ::-1])


def test_maps_of_another_shape_are_refused_by_name(tmp_path: Path) -> None:
    photo = photo_of_ramps(tmp_path, Intrinsics("PINHOLE", (60.0, 60, 48, 32), 96, 64))
    dataset = Dataset([photo], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    saved(tmp_path / "m.npy", np.ones((96, 64)))
    with pytest.raises(InputError, match=r"m\.npy: expected .* aspect ratio of the photo, 96x64 pixels, found 64x96"):
        load_depth_map(tmp_path / "m.npy", photo, dataset)


# ---- inverse depths


def test_inverse_depths() -> None:
    values = np.float32([[1, 2, np.nan], [4, 0.5, 8]])
    depths = DepthMap(values, scale=2, shift=-1)
    np.testing.assert_allclose(depths.disparities, [[1, 1 / 3, 0], [1 / 7, 0, 1 / 15]])  # 2 0.5 - 1 = 0: unknown
    assert depths.unit == pytest.approx((1 / 3 + 1 / 7) / 2)
    inverse = DepthMap(values, True, 2, -2)
    # Beyond infinity is far, and not unknown.
    np.testing.assert_allclose(inverse.disparities, [[14e-6, 2, 0], [6, 14e-6, 14]], rtol=1e-6)
    assert DepthMap(np.full((2, 2), np.nan, np.float32)).unit == 0


def test_smaller_photos_have_smaller_maps() -> None:
    """Coarse to fine: depths on the two sides of an edge are not mixed."""
    view = slanted_wall()[0].train[0]
    depth = replace(view.depth, values=np.where(np.arange(80) < 41, 1, 9) * np.ones((60, 1), np.float32), scale=3.0)
    small = shrunk(replace(view, depth=depth), 2)
    assert small.depth.values.shape == (30, 40) and small.depth.scale == 3
    assert set(np.unique(small.depth.values)) == {1, 9}


# ---- scales


def slanted_wall(photos: int = 3, points: int = 400) -> tuple[Scene, list[Any]]:
    """Photos of a wall z = 4 + x, points on it and hidden behind it; true depths (H, W) of each photo."""
    rng = np.random.default_rng(0)
    cameras = [Camera.look_at((x, 0, 0), (x, 0, 1), (0, -1, 0), 70, 80, 60) for x in (-0.5, 0.0, 0.5)[:photos]]
    truth, views = [], []
    for i, camera in enumerate(cameras):
        u, v = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
        rays = camera.rays(u, v) @ camera.viewmat[:3, :3]
        rays /= rays[..., 2:]
        truth.append((4 + camera.position[0]) / (1 - rays[..., 0]))
        views.append(View(f"{i}.png", camera, np.zeros((60, 80, 3), np.uint8)))
        views[-1] = replace(views[-1], depth=DepthMap(truth[-1].astype(np.float32)))
    x, y = rng.uniform(-2, 2, points), rng.uniform(-1.5, 1.5, points)
    wall = np.stack([x, y, 4 + x], axis=1)
    behind = wall[::3] * rng.uniform(1.5, 3, (len(wall[::3]), 1))  # a quarter of all
    every = np.concatenate([wall, behind])
    return Scene(views, [], every, np.zeros(every.shape, np.uint8)), truth


def with_maps(scene: Scene, change: Callable[[int, Any], Any], truth: list[Any]) -> Scene:
    maps = [DepthMap(np.asarray(change(i, z), np.float32)) for i, z in enumerate(truth)]
    return replace(scene, train=[replace(v, depth=m) for v, m in zip(scene.train, maps, strict=True)])


MAPS: dict[str, Callable[[int, Any], Any]] = {
    "depths": lambda i, z: z,
    "millimetres": lambda i, z: 1000 * z,
    "shifted depths": lambda i, z: (i + 2) * (z + i),
    "inverse depths": lambda i, z: 1 / z,
    "networks": lambda i, z: (300 + 100 * i) / z - 50 * i,
    "negative": lambda i, z: 1 / z - 1,
}


@pytest.mark.parametrize("kind", MAPS)
def test_scale_and_shift_are_found_despite_hidden_points(kind: str) -> None:
    scene, truth = slanted_wall()
    told: list[str] = []
    found = aligned(with_maps(scene, MAPS[kind], truth), told.append)
    for view, z in zip(found.train, truth, strict=True):
        # A point is compared with the pixel it falls into, whose centre is up to half a pixel away: 0.2 % of depth.
        np.testing.assert_allclose(1 / view.depth.disparities, z, rtol=0.01)
    name = "depths" if kind in ("depths", "millimetres", "shifted depths") else "inverse depths"
    assert told[0].startswith(f"depth maps: 3 of {name};")


def test_errors_of_the_map_are_averaged_out() -> None:
    """Every fifth pixel is wrong by any amount, the others by a few percent."""
    scene, truth = slanted_wall(points=2000)
    rng = np.random.default_rng(1)

    def rough(i: int, z: Any) -> Any:
        noisy = 1 / z * (1 + rng.normal(0, 0.03, z.shape))
        return 70 * np.where(rng.random(z.shape) < 0.2, rng.uniform(0, 1, z.shape), noisy) + 9

    for view, z in zip(aligned(with_maps(scene, rough, truth)).train, truth, strict=True):
        exact = (70 / z + 9) * view.depth.scale + view.depth.shift
        # Noise of the values lowers the slope by their share of the variance, most visible at the far edge.
        np.testing.assert_allclose(1 / exact, z, rtol=0.05)


@pytest.mark.parametrize("kind", ["depths", "inverse depths"])
def test_the_error_that_is_told_is_one_of_the_depth(kind: str) -> None:
    scene, truth = slanted_wall()
    rng = np.random.default_rng(0)
    told: list[str] = []
    aligned(
        with_maps(scene, lambda i, z: MAPS[kind](i, z * (1 + rng.choice([-0.03, 0.03], z.shape))), truth), told.append
    )
    found = re.search(r"differ from the points by (\d\.\d)% of the depth", told[0])
    # A point is up to half a pixel beside the centre of its pixel, and a fit to such errors changes some of them.
    assert found and float(found[1]) == pytest.approx(3, abs=0.3)


def test_what_maps_hold_is_decided_by_the_number_of_points() -> None:
    """One whole map of inverse depths against two parts of depths."""
    scene, truth = slanted_wall()
    column = np.arange(80)[None]
    mixed = with_maps(scene, lambda i, z: 1 / z if i == 0 else np.where(abs(column - 40) < 5, z, np.nan), truth)
    with pytest.warns(UserWarning, match="2 of 3 depth maps do not agree"):
        found = aligned(mixed)
    assert found.train[0].depth is not None and found.train[0].depth.inverse


def test_the_unit_of_the_world_does_not_matter() -> None:
    scene, truth = slanted_wall()

    def shrunken(view: View) -> View:
        viewmat = view.camera.viewmat.copy()
        viewmat[:3, 3] *= 1e-4
        return replace(view, camera=replace(view.camera, viewmat=viewmat, near=1e-6))

    small = replace(scene, points=1e-4 * scene.points, train=[shrunken(v) for v in scene.train])
    a, b = (aligned(with_maps(s, MAPS["networks"], truth)) for s in (scene, small))
    for view, other in zip(a.train, b.train, strict=True):
        np.testing.assert_allclose(1e-4 * other.depth.disparities, view.depth.disparities, rtol=1e-4)


def test_maps_of_other_photos_are_left_out_with_a_warning() -> None:
    scene, truth = slanted_wall()
    mixed = with_maps(scene, lambda i, z: z[:, ::-1] if i == 1 else z, truth)
    with pytest.warns(UserWarning, match=r"1 of 3 depth maps do not agree .* \(first: 1\.png\)"):
        found = aligned(mixed)
    assert [view.depth is None for view in found.train] == [False, True, False]


def test_photos_that_show_few_points_have_no_map() -> None:
    scene, _ = slanted_wall()
    far = replace(scene.train[2], camera=Camera.look_at((50, 0, 0), (50, 0, 1), (0, -1, 0), 70, 80, 60))
    some = replace(scene, train=[*scene.train[:2], far])
    with pytest.warns(UserWarning, match=rf"1 of 3 depth maps .* show fewer than {POINTS_MIN}, .* \(first: 2\.png\)"):
        assert aligned(some).train[2].depth is None


def test_what_cannot_be_scaled_is_refused() -> None:
    scene, truth = slanted_wall()
    with pytest.raises(InputError, match=r"--depth: expected a scene with points.*no-triangulate where it was given"):
        aligned(replace(scene, points=np.zeros((0, 3))))
    for change in (lambda i, z: 0 * z + 3, lambda i, z: np.random.default_rng(i).random(z.shape) + 1):
        with pytest.raises(
            InputError, match="--depth: expected depth maps that agree with the scene's points, found n"
        ):
            aligned(with_maps(scene, change, truth))
