"""Decoding of photos to views: names and files, sizes, orientations, masks."""

import warnings

import numpy as np
import pytest
from PIL import Image

from clsplat.camera import Camera
from clsplat.config import DataConfig
from clsplat.dataset.decoding import Dataset, PosedPhoto, load_views
from clsplat.dataset.finding import PhotosMissing, checked_name, find_mask, locate, mask_folder
from clsplat.dataset.lenses import Intrinsics
from clsplat.errors import InputError

RNG = np.random.default_rng(11)
PINHOLE = Intrinsics("PINHOLE", (50.0, 60.0, 30.0, 25.0), 64, 48)


def save(path, pixels, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def posed(path, intrinsics=PINHOLE, viewmat=None, mask=None):
    return PosedPhoto(path.name, path, np.eye(4) if viewmat is None else viewmat, intrinsics, mask)


def load(*photos, reduce=1, upright=False, **options):
    dataset = Dataset(list(photos), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), reduce, reduce, upright)
    return load_views(dataset, DataConfig(**options))


def noise(width=64, height=48):
    return RNG.integers(0, 256, (height, width, 3)).astype(np.uint8)


# ---- names and files


@pytest.mark.parametrize(
    ("name", "expected"),
    [("a.jpg", "a.jpg"), ("./train/r_0", "train/r_0"), ("sub\\a.jpg", "sub/a.jpg"), ("a..b/c", "a..b/c")],
)
def test_names_are_normalised(tmp_path, name, expected):
    assert checked_name(name, tmp_path) == expected


@pytest.mark.parametrize(
    "name", ["", ".", "../a.jpg", "sub/../../a.jpg", "/etc/a.jpg", "C:\\a.jpg", "..\\a.jpg", "a\0.jpg"]
)
def test_names_that_leave_the_dataset_are_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"images\.bin"):
        checked_name(name, tmp_path / "images.bin")


def touch(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


def test_the_size_asked_for_is_preferred(tmp_path):
    touch(tmp_path, "images/a.jpg", "images/s/b.jpg", "images_4/a.png", "images_4/s/b.png")
    names = ["images/a.jpg", "images/s/b.jpg"]
    assert locate(tmp_path, names, 1) == ([tmp_path / name for name in names], 1, 1)
    assert locate(tmp_path, names, 2) == ([tmp_path / name for name in names], 2, 2)
    assert locate(tmp_path, names, 4) == ([tmp_path / "images_4/a.png", tmp_path / "images_4/s/b.png"], 1, 4)


@pytest.mark.parametrize(
    ("screen", "expected"), [(3072, 1), (3071, 2), (768, 2), (767, 3), (342, 3), (341, 4), (13, 16), (1, 16)]
)
def test_the_largest_photo_fits_a_screen(tmp_path, monkeypatch, screen, expected):
    """Of two photos with 3072 and 768 pixels."""
    save(tmp_path / "a.png", noise(64, 48))
    save(tmp_path / "b.png", noise(24, 32))
    monkeypatch.setattr("clsplat.dataset.finding.SCREEN", screen)
    assert locate(tmp_path, ["b.png", "a.png", "c.png"], "auto")[1:] == (expected, expected)


def test_photos_beside_a_panorama_fit_a_screen(tmp_path, monkeypatch):
    """A face of a panorama of 2048 pixels has 415, the photo 768."""
    save(tmp_path / "panorama.png", noise(64, 32))
    save(tmp_path / "photo.png", noise(32, 24))
    names = ["panorama.png", "photo.png"]
    for screen, cut, expected in (768, [True, False], 1), (767, [True, False], 2), (768, [False, False], 2):
        monkeypatch.setattr("clsplat.dataset.finding.SCREEN", screen)
        assert locate(tmp_path, names, "auto", cut)[2] == expected
    monkeypatch.setattr("clsplat.dataset.finding.SCREEN", 416)
    assert [locate(tmp_path, names[:1], "auto", [cut])[2] for cut in (True, False)] == [1, 3]


def test_smaller_copies_are_read_where_photos_exceed_a_screen(tmp_path, monkeypatch):
    save(tmp_path / "images/a.png", noise(64, 48))
    save(tmp_path / "images_3/a.png", noise(21, 16))
    monkeypatch.setattr("clsplat.dataset.finding.SCREEN", 342)
    assert locate(tmp_path, ["images/a.png"], "auto") == ([tmp_path / "images_3/a.png"], 1, 3)
    with pytest.raises(PhotosMissing, match=r"b\.png"):
        locate(tmp_path, ["images/b.png"], "auto")


def test_the_largest_copies_are_read_where_there_are_only_copies(tmp_path):
    touch(tmp_path, "images_8/a.jpg", "images_4/a.jpg")
    assert locate(tmp_path, ["images/a.jpg"], "auto") == ([tmp_path / "images_4/a.jpg"], 1, 4)


def test_a_size_that_exists_for_some_photos_only_is_not_mixed_in(tmp_path):
    touch(tmp_path, "images/a.jpg", "images/b.jpg", "images_2/a.jpg")
    with pytest.warns(UserWarning, match="1 of 2"):
        files, reduce, _ = locate(tmp_path, ["images/a.jpg", "images/b.jpg"], 2)
    assert reduce == 2 and files == [tmp_path / "images/a.jpg", tmp_path / "images/b.jpg"]


def test_photos_in_the_datasets_own_folder_have_no_smaller_copies(tmp_path):
    touch(tmp_path, "a.jpg")
    assert locate(tmp_path, ["a.jpg"], 2) == ([tmp_path / "a.jpg"], 2, 2)


def test_absent_photos_are_none_and_all_absent_is_an_error(tmp_path):
    touch(tmp_path, "images/a.jpg", "images_8/a.jpg")
    assert locate(tmp_path, ["images/a.jpg", "images/b.jpg"], 1)[0] == [tmp_path / "images/a.jpg", None]
    (tmp_path / "images/a.jpg").unlink()
    with pytest.raises(PhotosMissing, match=r"a\.jpg.*downscale 8"):
        locate(tmp_path, ["images/a.jpg", "images/b.jpg"], 1)
    with pytest.raises(PhotosMissing, match=r"cannot find any .*c\.jpg$"):
        locate(tmp_path, ["images/c.jpg"], 1)


def test_a_file_belongs_to_one_name(tmp_path):
    touch(tmp_path, "a.png", "b.webp")
    assert locate(tmp_path, ["a.jpg", "a.png"], 1)[0] == [None, tmp_path / "a.png"]
    assert locate(tmp_path, ["b", "b.jpg"], 1)[0] == [tmp_path / "b.webp", None]


def test_masks_are_found_by_both_names(tmp_path):
    touch(tmp_path, "masks/a.png", "masks/s/b.jpg.png")
    assert mask_folder(tmp_path, "masks") == tmp_path / "masks"
    assert find_mask(tmp_path / "masks", "a.jpg") == tmp_path / "masks/a.png"
    assert find_mask(tmp_path / "masks", "s/b.jpg") == tmp_path / "masks/s/b.jpg.png"
    touch(tmp_path, "masks/render.png", "masks/render.0001.png")
    for name in ("render.0001", "render.0001.png"):
        assert find_mask(tmp_path / "masks", name) == tmp_path / "masks/render.0001.png"
    with pytest.raises(InputError, match=r"c\.png"):
        find_mask(tmp_path / "masks", "c.jpg")
    with pytest.raises(InputError, match="nowhere"):
        mask_folder(tmp_path, "nowhere")


# ---- cameras and sizes


def test_a_pinhole_photo_is_not_touched(tmp_path):
    pixels = noise()
    (view,) = load(posed(save(tmp_path / "a.png", pixels)))
    np.testing.assert_array_equal(view.image, pixels)
    camera = view.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 60, 30, 25)
    assert (camera.width, camera.height) == (64, 48) and view.mask is None


def test_intrinsics_follow_the_files_size_per_axis(tmp_path):
    declared = Intrinsics("SIMPLE_PINHOLE", (100.0, 60.0, 50.0), 127, 95)  # half the size is 63.5 x 47.5
    (view,) = load(posed(save(tmp_path / "a.png", noise(63, 48)), declared))
    camera = view.camera
    assert (camera.width, camera.height) == (63, 48)
    np.testing.assert_allclose(
        [camera.fx, camera.fy, camera.cx, camera.cy], [100 * 63 / 127, 100 * 48 / 95, 60 * 63 / 127, 50 * 48 / 95]
    )


def test_rounding_costs_no_pixel(tmp_path):
    """23 (13/23) is 12.999999999999998 in double precision."""
    (view,) = load(posed(save(tmp_path / "a.png", noise(13, 13)), Intrinsics("PINHOLE", (50.0, 60, 11, 11), 23, 23)))
    assert view.image.shape == (13, 13, 3) and (view.camera.width, view.camera.height) == (13, 13)


def test_reduction_averages_squares_of_pixels(tmp_path):
    pixels = noise(66, 49)
    declared = Intrinsics("PINHOLE", (50.0, 60.0, 30.0, 25.0), 66, 49)
    (view,) = load(posed(save(tmp_path / "a.png", pixels), declared), reduce=4)
    expected = pixels[:48, :64].reshape(12, 4, 16, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(view.image, expected, atol=0.5)
    camera = view.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (12.5, 15, 7.5, 6.25)
    with pytest.raises(InputError, match=r"a\.png.*64 pixels"):
        load(posed(tmp_path / "a.png", declared), reduce=64)


def test_views_keep_order_and_share_no_pixels(tmp_path):
    images = [noise() for _ in range(9)]
    views = load(*(posed(save(tmp_path / f"{k}.png", pixels)) for k, pixels in enumerate(images)))
    for k, view in enumerate(views):
        assert view.name == f"{k}.png"
        np.testing.assert_array_equal(view.image, images[k])


def turned(tag):
    exif = Image.Exif()
    exif[0x0112] = tag
    return exif


ENDINGS = pytest.mark.parametrize("ending", ["png", "tif"])  # Pillow itself turns a TIFF


@ENDINGS
@pytest.mark.parametrize("tag", [1, 3, 6])
def test_orientation_is_ignored_where_stored_pixels_fit(tmp_path, tag, ending):
    pixels = noise()
    path = save(tmp_path / f"a.{ending}", pixels, exif=turned(tag))
    np.testing.assert_array_equal(load(posed(path))[0].image, pixels)


@ENDINGS
def test_orientation_is_applied_where_only_the_upright_photo_fits(tmp_path, ending):
    pixels = noise(48, 64)
    path = save(tmp_path / f"a.{ending}", pixels, exif=turned(6))
    np.testing.assert_array_equal(load(posed(path))[0].image, pixels.swapaxes(0, 1)[:, ::-1])


@ENDINGS
def test_upright_datasets_apply_every_orientation(tmp_path, ending):
    pixels = noise()
    path = save(tmp_path / f"a.{ending}", pixels, exif=turned(3))
    np.testing.assert_array_equal(load(posed(path), upright=True)[0].image, pixels[::-1, ::-1])


def test_a_photo_of_another_shape_is_refused(tmp_path):
    path = save(tmp_path / "wide.png", noise(64, 40))
    with pytest.raises(InputError, match=r"wide\.png.*64x48.*64x40"):
        load(posed(path))


def test_bad_poses_are_refused_with_the_photos_name(tmp_path):
    path = save(tmp_path / "mirror.png", noise())
    for viewmat in (np.diag([-1.0, 1, 1, 1]), np.diag([2.0, 2, 2, 1]), np.full((4, 4), np.nan)):
        with pytest.raises(InputError, match=r"mirror\.png"):
            load(posed(path, viewmat=viewmat))


def test_a_damaged_photo_is_refused_by_name(tmp_path):
    good, bad = save(tmp_path / "good.png", noise()), save(tmp_path / "bad.png", noise())
    data = bad.read_bytes()
    bad.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match=r"bad\.png"):
        load(posed(good), posed(bad))


def test_headers_are_checked_before_any_photo_is_decoded(tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.dataset.decoding.read_photo", lambda *_: pytest.fail("decoded"))
    photos = [posed(save(tmp_path / f"{k}.png", noise())) for k in range(3)]
    (tmp_path / "x.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"x\.png"):
        load(*photos, posed(tmp_path / "x.png"))


# ---- memory


def test_masks_and_transparency_count_among_the_bytes_of_photos(tmp_path):
    """A photo takes 3 bytes per pixel, its mask and its transparency 1 each."""
    rgba = np.dstack([noise(), np.full((48, 64), 100, np.uint8)])
    photo, mask = save(tmp_path / "a.png", rgba), save(tmp_path / "m.png", np.full((48, 64), 255, np.uint8))
    dataset = Dataset([posed(photo, mask=mask)], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    config = DataConfig(random_background=True)
    (view,) = load_views(dataset, config, memory=5 * 64 * 48)
    assert not view.ahead and view.mask is not None and view.clear is not None
    (view,) = load_views(dataset, config, memory=5 * 64 * 48 - 1)
    assert view.ahead, "it streams"


@pytest.mark.parametrize(
    ("downscale", "available", "remedy"),
    [(1, 10_800, "--downscale 4"), (3, 9_900, "--downscale 4"), (2, 9_500, "--downscale 8"), (16, 0, "use smaller")],
)
def test_photos_that_do_not_fit_the_memory_are_named_with_a_remedy(
    tmp_path, monkeypatch, downscale, available, remedy
):
    """The larger file takes 9216 bytes, and as many once more where it is not reduced."""
    monkeypatch.setattr("clsplat.dataset.decoding.physical_memory", lambda: available)
    small = posed(
        save(tmp_path / "small.png", noise(32, 24)), Intrinsics("PINHOLE", (50.0, 60.0, 16.0, 12.0), 32, 24)
    )
    large = posed(save(tmp_path / "large.png", noise()))
    with pytest.raises(InputError, match=rf"large\.png: expected photos that fit .*; {remedy}"):
        load(small, large, reduce=downscale)


# ---- masks


def test_masks_take_the_photos_size(tmp_path):
    small = RNG.integers(0, 2, (24, 32)).astype(bool)
    photo, mask = save(tmp_path / "a.png", noise()), save(tmp_path / "m.png", small.astype(np.uint8) * 255)
    (view,) = load(posed(photo, mask=mask))
    np.testing.assert_array_equal(view.mask, np.kron(small, np.ones((2, 2), bool)))


def test_inverted_masks_train_black_and_averages_of_black_alone(tmp_path):
    full = RNG.integers(0, 8, (48, 64)) == 0
    photo, mask = save(tmp_path / "a.png", noise()), save(tmp_path / "m.png", full.astype(np.uint8) * 255)
    (view,) = load(posed(photo, mask=mask), invert_masks=True)
    np.testing.assert_array_equal(view.mask, ~full)
    (view,) = load(posed(photo, mask=mask), reduce=2, invert_masks=True)
    np.testing.assert_array_equal(view.mask, ~full.reshape(24, 2, 32, 2).any(axis=(1, 3)))


def test_reduced_masks_count_pixels_without_a_masked_part(tmp_path):
    full = RNG.integers(0, 8, (48, 64)) > 0
    photo, mask = save(tmp_path / "a.png", noise()), save(tmp_path / "m.png", full.astype(np.uint8) * 255)
    (view,) = load(posed(photo, mask=mask), reduce=2)
    np.testing.assert_array_equal(view.mask, full.reshape(24, 2, 32, 2).all(axis=(1, 3)))


@ENDINGS
def test_the_orientation_of_a_mask_counts_as_that_of_its_photo(tmp_path, ending):
    pattern = RNG.integers(0, 2, (48, 64)).astype(bool)
    photo = save(tmp_path / f"a.{ending}", noise(), exif=turned(6))
    mask = save(tmp_path / f"m.{ending}", pattern.astype(np.uint8) * 255, exif=turned(6))
    np.testing.assert_array_equal(load(posed(photo, mask=mask))[0].mask, pattern)
    tall = Intrinsics("PINHOLE", (60.0, 50.0, 25.0, 30.0), 48, 64)
    upright = load(posed(photo, tall, mask=mask), upright=True)[0].mask
    np.testing.assert_array_equal(upright, pattern.swapaxes(0, 1)[:, ::-1])


def test_a_mask_of_another_shape_is_refused(tmp_path):
    photo, mask = save(tmp_path / "a.png", noise()), save(tmp_path / "m.png", np.zeros((64, 48), np.uint8))
    with pytest.raises(InputError, match=r"m\.png.*64x48.*48x64"):
        load(posed(photo, mask=mask))


def test_no_warning_on_the_way(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (view,) = load(posed(save(tmp_path / "a.png", noise())))
    assert isinstance(view.camera, Camera)
