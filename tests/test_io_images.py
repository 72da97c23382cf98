"""Photos with cameras become views: files found, distortion undone, sizes, masks and orientations respected."""

import warnings

import numpy as np
import pytest
from PIL import Image

from clsplat.camera import Camera
from clsplat.config import DataConfig
from clsplat.errors import InputError
from clsplat.io.files import PhotosMissing, checked_name, find_mask, locate, mask_folder
from clsplat.io.images import Dataset, PosedPhoto, _positions, load_views
from clsplat.lenses import Intrinsics, project, undistorted

RNG = np.random.default_rng(11)
PINHOLE = Intrinsics("PINHOLE", (50.0, 60.0, 30.0, 25.0), 64, 48)


def save(path, pixels, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def posed(path, intrinsics=PINHOLE, viewmat=None, mask=None):
    return PosedPhoto(path.name, path, np.eye(4) if viewmat is None else viewmat, intrinsics, mask)


def load(*photos, reduce=1, upright=False, **options):
    dataset = Dataset(list(photos), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), reduce, upright)
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
    assert locate(tmp_path, names, 1) == ([tmp_path / name for name in names], 1)
    assert locate(tmp_path, names, 2) == ([tmp_path / name for name in names], 2)
    assert locate(tmp_path, names, 4) == ([tmp_path / "images_4/a.png", tmp_path / "images_4/s/b.png"], 1)


def test_a_size_that_exists_for_some_photos_only_is_not_mixed_in(tmp_path):
    touch(tmp_path, "images/a.jpg", "images/b.jpg", "images_2/a.jpg")
    with pytest.warns(UserWarning, match="1 of 2"):
        files, reduce = locate(tmp_path, ["images/a.jpg", "images/b.jpg"], 2)
    assert reduce == 2 and files == [tmp_path / "images/a.jpg", tmp_path / "images/b.jpg"]


def test_photos_in_the_datasets_own_folder_have_no_smaller_copies(tmp_path):
    touch(tmp_path, "a.jpg")
    assert locate(tmp_path, ["a.jpg"], 2) == ([tmp_path / "a.jpg"], 2)


def test_absent_photos_are_none_and_all_absent_is_an_error(tmp_path):
    touch(tmp_path, "images/a.jpg", "images_8/a.jpg")
    assert locate(tmp_path, ["images/a.jpg", "images/b.jpg"], 1)[0] == [tmp_path / "images/a.jpg", None]
    (tmp_path / "images/a.jpg").unlink()
    with pytest.raises(PhotosMissing, match=r"a\.jpg.*downscale 8"):
        locate(tmp_path, ["images/a.jpg", "images/b.jpg"], 1)
    with pytest.raises(PhotosMissing, match=r"none of them$"):
        locate(tmp_path, ["images/c.jpg"], 1)


def test_masks_are_found_by_both_names(tmp_path):
    touch(tmp_path, "masks/a.png", "masks/s/b.jpg.png")
    assert mask_folder(tmp_path, "masks") == tmp_path / "masks"
    assert find_mask(tmp_path / "masks", "a.jpg") == tmp_path / "masks/a.png"
    assert find_mask(tmp_path / "masks", "s/b.jpg") == tmp_path / "masks/s/b.jpg.png"
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
    declared = Intrinsics("SIMPLE_PINHOLE", (100.0, 60.0, 50.0), 127, 95)  # half of it is 63.5 x 47.5
    (view,) = load(posed(save(tmp_path / "a.png", noise(63, 48)), declared))
    camera = view.camera
    assert (camera.width, camera.height) == (63, 48)
    np.testing.assert_allclose(
        [camera.fx, camera.fy, camera.cx, camera.cy], [100 * 63 / 127, 100 * 48 / 95, 60 * 63 / 127, 50 * 48 / 95]
    )


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


@pytest.mark.parametrize("tag", [1, 3, 6])
def test_orientation_is_ignored_where_stored_pixels_fit(tmp_path, tag):
    exif = Image.Exif()
    exif[0x0112] = tag
    pixels = noise()
    path = save(tmp_path / "a.png", pixels, exif=exif)
    np.testing.assert_array_equal(load(posed(path))[0].image, pixels)


def test_orientation_is_applied_where_only_the_upright_photo_fits(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    pixels = noise(48, 64)
    path = save(tmp_path / "a.png", pixels, exif=exif)
    np.testing.assert_array_equal(load(posed(path))[0].image, pixels.swapaxes(0, 1)[:, ::-1])


def test_upright_datasets_apply_every_orientation(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 3
    pixels = noise()
    path = save(tmp_path / "a.png", pixels, exif=exif)
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
    monkeypatch.setattr("clsplat.io.images.read_photo", lambda *_: pytest.fail("decoded"))
    photos = [posed(save(tmp_path / f"{k}.png", noise())) for k in range(3)]
    (tmp_path / "x.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"x\.png"):
        load(*photos, posed(tmp_path / "x.png"))


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


def test_a_mask_of_another_shape_is_refused(tmp_path):
    photo, mask = save(tmp_path / "a.png", noise()), save(tmp_path / "m.png", np.zeros((64, 48), np.uint8))
    with pytest.raises(InputError, match=r"m\.png.*64x48.*48x64"):
        load(posed(photo, mask=mask))


# ---- distortion

DISTORTED = {
    "SIMPLE_RADIAL": (120.0, 82.0, 58.0, -0.08),
    "RADIAL": (120.0, 82.0, 58.0, 0.06, -0.02),
    "OPENCV": (120.0, 125.0, 82.0, 58.0, -0.1, 0.03, 0.004, -0.003),
    "FULL_OPENCV": (120.0, 125.0, 82.0, 58.0, -0.1, 0.03, 0.004, -0.003, 0.01, 0.02, 0.01, 0.005),
    "THIN_PRISM_FISHEYE": (120.0, 125.0, 82.0, 58.0, 0.02, -0.01, 0.002, 0.001, 0.0, 0.0, 0.002, 0.001),
    "FOV": (120.0, 125.0, 82.0, 58.0, 0.7),
}


def pattern(x, y):
    """Colour of the ray (x, y, 1): it changes by up to 10 levels per pixel at a focal length of 120."""
    return 127.5 + 100 * np.stack([np.sin(12 * x), np.cos(11 * y), np.sin(8 * (x + y))], axis=-1)


def distorted_photo(intrinsics, width, height):
    """What a camera sees of `pattern`, through COLMAP's inverse of the functions that undistortion uses."""
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, intrinsics.model, 1.0, intrinsics.width, intrinsics.height)
    camera.params = intrinsics.params
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x * intrinsics.width / width, y * intrinsics.height / height], axis=-1)
    rays = camera.cam_from_img(pixels.reshape(-1, 2)).reshape(height, width, 2)
    return np.rint(pattern(rays[..., 0], rays[..., 1])).astype(np.uint8)


def ray_grid(camera):
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy


@pytest.mark.parametrize("size", [(160, 120), (80, 60)], ids=["full", "half"])
@pytest.mark.parametrize("model", DISTORTED)
def test_distortion_is_undone(tmp_path, model, size):
    intrinsics = Intrinsics(model, DISTORTED[model], 160, 120)
    (view,) = load(posed(save(tmp_path / "a.png", distorted_photo(intrinsics, *size)), intrinsics))
    camera = view.camera
    assert view.image.shape == (camera.height, camera.width, 3)
    # No black border and not much lost: blank_pixels = 0 keeps nearly all of these mild distortions.
    assert 0.75 * size[0] < camera.width < 1.25 * size[0]
    error = np.abs(view.image.astype(float) - pattern(*ray_grid(camera)))
    # Two roundings to 8 bits are 1; bilinear interpolation of 100 sin(12 x) in steps h is 100 * 12^2/8 * h^2, with
    # h = 1/120 (1/60 at half size), and up to 3 times that where a fisheye shrinks. Half a pixel off gives 5 (10).
    assert error.max() < 1.5 + 3 * 1800 * (160 / size[0] / 120) ** 2


@pytest.mark.parametrize("model", DISTORTED)
def test_undistortion_agrees_with_colmaps(tmp_path, model):
    import pycolmap

    intrinsics = Intrinsics(model, DISTORTED[model], 160, 120)
    camera = pycolmap.Camera.create_from_model_name(1, model, 1.0, 160, 120)
    camera.params = intrinsics.params
    photo = distorted_photo(intrinsics, 160, 120)
    options = pycolmap.UndistortCameraOptions(blank_pixels=0.0)
    theirs, pinhole = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(photo), camera)
    (view,) = load(posed(save(tmp_path / "a.png", photo), intrinsics))
    ours = view.camera
    assert (ours.width, ours.height) == (pinhole.width, pinhole.height)
    np.testing.assert_allclose((ours.fx, ours.fy, ours.cx, ours.cy), pinhole.params, rtol=1e-12)
    inner = np.s_[1:-1, 1:-1]  # at the border COLMAP paints black what lies half a pixel outside
    # Both are bilinear and rounded once.
    np.testing.assert_allclose(view.image[inner].astype(int), theirs.to_array()[inner], atol=1)


def test_positions_are_the_distortion_of_the_pinholes_rays():
    """One pixel by hand: SIMPLE_RADIAL is x (1 + k r^2)."""
    intrinsics = Intrinsics("SIMPLE_RADIAL", (100.0, 60.0, 40.0, 0.1), 120, 80)
    pinhole = undistorted(intrinsics)
    fx, fy, cx, cy = pinhole.params
    row, column = 10, 70
    x, y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
    scale = 100 * (1 + 0.1 * (x * x + y * y))
    positions = _positions(intrinsics, (120, 80), (pinhole.height, pinhole.width))
    # float32 positions of up to 120 pixels
    np.testing.assert_allclose(positions[:, row, column], [40 + scale * y - 0.5, 60 + scale * x - 0.5], atol=1e-4)


def test_reduction_comes_after_undistortion(tmp_path):
    intrinsics = Intrinsics("OPENCV", DISTORTED["OPENCV"], 160, 120)
    path = save(tmp_path / "a.png", distorted_photo(intrinsics, 160, 120))
    (full,), (half,) = load(posed(path, intrinsics)), load(posed(path, intrinsics), reduce=2)
    rows, columns = half.image.shape[:2]
    expected = full.image[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(half.image, expected, atol=0.5)
    assert half.camera.fx == full.camera.fx / 2 and half.camera.cx == full.camera.cx / 2


def test_masks_are_undistorted_like_photos(tmp_path):
    intrinsics = Intrinsics("OPENCV", DISTORTED["OPENCV"], 160, 120)
    photo = distorted_photo(intrinsics, 160, 120)
    mask = save(tmp_path / "m.png", (photo[..., 0] > 127).astype(np.uint8) * 255)
    (view,) = load(posed(save(tmp_path / "a.png", photo), intrinsics, mask=mask))
    red = pattern(*ray_grid(view.camera))[..., 0]
    clear = np.abs(red - 127.5) > 12  # more than a pixel from the mask's edge
    assert clear.mean() > 0.8
    np.testing.assert_array_equal(view.mask[clear], (red > 127.5)[clear])


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV"])
def test_zero_coefficients_are_a_plain_pinhole(tmp_path, model):
    params = DISTORTED[model][: 4 if model != "SIMPLE_RADIAL" else 3]
    intrinsics = Intrinsics(model, params + (0.0,) * (len(DISTORTED[model]) - len(params)), 64, 48)
    pixels = noise()
    (view,) = load(posed(save(tmp_path / "a.png", pixels), intrinsics))
    np.testing.assert_array_equal(view.image, pixels)
    assert view.camera.fx == params[0]


FISHEYES = {
    "OPENCV_FISHEYE": (50.0, 52.0, 82.0, 58.0, 0.02, -0.01, 0.005, 0.001),
    "FISHEYE": (50.0, 52.0, 82.0, 58.0),
    "SIMPLE_FISHEYE": (50.0, 82.0, 58.0),
    "SIMPLE_RADIAL_FISHEYE": (50.0, 82.0, 58.0, 0.03),
    "RADIAL_FISHEYE": (50.0, 82.0, 58.0, 0.03, -0.01),
}


@pytest.mark.parametrize("model", FISHEYES)
def test_fisheyes_stay_as_they_are(tmp_path, model):
    """Not a pixel is resampled, and the camera is COLMAP's: its directions appear where COLMAP says."""
    intrinsics, pixels = Intrinsics(model, FISHEYES[model], 160, 120), noise(160, 120)
    (view,) = load(posed(save(tmp_path / "a.png", pixels), intrinsics))
    np.testing.assert_array_equal(view.image, pixels)
    assert view.camera.model == "fisheye"
    u, v = np.meshgrid(np.linspace(5, 155, 16), np.linspace(5, 115, 12))
    rays = view.camera.rays(u, v)
    front = rays[..., 2] > 0.1  # COLMAP's function has no points behind
    assert front.mean() > 0.6
    np.testing.assert_allclose(project(intrinsics, rays[front]), np.stack([u, v], axis=-1)[front], atol=1e-9)


def test_a_smaller_fisheye_keeps_its_coefficients(tmp_path):
    intrinsics = Intrinsics("OPENCV_FISHEYE", FISHEYES["OPENCV_FISHEYE"], 160, 120)
    (view,) = load(posed(save(tmp_path / "a.png", noise(160, 120)), intrinsics), reduce=2)
    assert (view.camera.width, view.camera.fx, view.camera.cy) == (80, 25, 29)
    assert view.camera.distortion == (0.02, -0.01, 0.005, 0.001)


def test_beyond_a_fisheyes_image_nothing_counts(tmp_path):
    """theta - 0.1 theta^3 is largest at a radius of 1.217, 24.3 px; a mask of the user's counts too."""
    intrinsics = Intrinsics("SIMPLE_RADIAL_FISHEYE", (20.0, 32.0, 32.0, -0.1), 64, 64)
    user = np.full((64, 64), 255, np.uint8)
    user[30:34, 30:34] = 0
    path, mask = save(tmp_path / "a.png", noise(64, 64)), save(tmp_path / "m.png", user)
    (view,), (masked,) = load(posed(path, intrinsics)), load(posed(path, intrinsics, mask=mask))
    x, y = np.meshgrid(np.arange(64) - 31.5, np.arange(64) - 31.5)
    np.testing.assert_array_equal(view.mask, np.hypot(x, y) <= 20 * 2 / 3 * np.sqrt(1 / 0.3))
    np.testing.assert_array_equal(masked.mask, view.mask & (user > 0))


@pytest.mark.parametrize(
    ("intrinsics", "message"),
    [
        (Intrinsics("PINBALL", (64.0, 48.0), 64, 48), "PINBALL"),
        (Intrinsics("OPENCV", (64.0, 48.0), 64, 48), "8 parameters"),
        (Intrinsics("DIVISION", (48.0, 48.0, 32.0, 24.0, 30.0), 64, 48), r"DIVISION.*undone"),  # NaN
        (Intrinsics("SIMPLE_RADIAL", (48.0, 1e19, 24.0, 0.01), 64, 48), r"SIMPLE_RADIAL.*undone"),  # overflow
        (Intrinsics("SIMPLE_RADIAL", (1e-320, 32.0, 24.0, 0.01), 64, 48), r"expected|undone"),  # overflow
        (
            Intrinsics("FULL_OPENCV", (48.0, 48.0, 32.0, 24.0, *5 * [0.0], -10.0, 0.0, 0.0), 64, 48),
            "undone",
        ),  # a pole
    ],
)
def test_cameras_that_cannot_become_pinholes_are_refused(tmp_path, intrinsics, message):
    with pytest.raises(InputError, match=message):
        load(posed(save(tmp_path / "a.png", noise()), intrinsics))


def test_no_warning_on_the_way(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (view,) = load(posed(save(tmp_path / "a.png", noise())))
    assert isinstance(view.camera, Camera)
