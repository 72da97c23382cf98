"""Lenses: distortion is undone, fisheyes are kept, and cameras that cannot become a pinhole are refused."""

import json
import subprocess
import sys

import numpy as np
import pytest
from test_decoding import load, noise, posed, save
from test_transforms import frames

from clsplat.dataset.lenses import Intrinsics, project, undistorted
from clsplat.dataset.undistortion import lens_positions
from clsplat.errors import InputError

DISTORTED = {
    "SIMPLE_RADIAL": (120.0, 82.0, 58.0, -0.08),
    "RADIAL": (120.0, 82.0, 58.0, 0.06, -0.02),
    "OPENCV": (120.0, 125.0, 82.0, 58.0, -0.1, 0.03, 0.004, -0.003),
    "FULL_OPENCV": (120.0, 125.0, 82.0, 58.0, -0.1, 0.03, 0.004, -0.003, 0.01, 0.02, 0.01, 0.005),
    "THIN_PRISM_FISHEYE": (120.0, 125.0, 82.0, 58.0, 0.02, -0.01, 0.002, 0.001, 0.0, 0.0, 0.002, 0.001),
    "FOV": (120.0, 125.0, 82.0, 58.0, 0.7),
}


def pattern(x, y):
    """Colour of the ray (x, y, 1), which changes by up to 10 levels per pixel at a focal length of 120 px."""
    return 127.5 + 100 * np.stack([np.sin(12 * x), np.cos(11 * y), np.sin(8 * (x + y))], axis=-1)


def distorted_photo(intrinsics, width, height):
    """Render `pattern` with a camera, through COLMAP's inverse of the functions that undistortion uses."""
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
    # No black border and little loss: blank_pixels = 0 keeps nearly all of these mildly distorted photos.
    assert 0.75 * size[0] < camera.width < 1.25 * size[0]
    error = np.abs(view.image.astype(float) - pattern(*ray_grid(camera)))
    # Two roundings to 8 bits cost 1 level. Bilinear interpolation of 100 sin(12 x) in steps h costs 100 * 12^2/8 *
    # h^2, with h = 1/120 (1/60 at half size), and up to 3 times that where a fisheye shrinks the image. An offset of
    # half a pixel would cost 5 (10).
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
    inner = np.s_[1:-1, 1:-1]  # COLMAP paints pixels half a pixel outside black
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
    positions = lens_positions(intrinsics, (120, 80), (pinhole.height, pinhole.width))
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
    """No pixel is resampled, and the camera projects directions as COLMAP's does."""
    intrinsics, pixels = Intrinsics(model, FISHEYES[model], 160, 120), noise(160, 120)
    (view,) = load(posed(save(tmp_path / "a.png", pixels), intrinsics))
    np.testing.assert_array_equal(view.image, pixels)
    assert view.camera.model == "fisheye"
    u, v = np.meshgrid(np.linspace(5, 155, 16), np.linspace(5, 115, 12))
    rays = view.camera.rays(u, v)
    front = rays[..., 2] > 0.1  # COLMAP projects no points behind the camera
    assert front.mean() > 0.6
    np.testing.assert_allclose(project(intrinsics, rays[front]), np.stack([u, v], axis=-1)[front], atol=1e-9)


def test_a_smaller_fisheye_keeps_its_coefficients(tmp_path):
    intrinsics = Intrinsics("OPENCV_FISHEYE", FISHEYES["OPENCV_FISHEYE"], 160, 120)
    (view,) = load(posed(save(tmp_path / "a.png", noise(160, 120)), intrinsics), reduce=2)
    assert (view.camera.width, view.camera.fx, view.camera.cy) == (80, 25, 29)
    assert view.camera.distortion == (0.02, -0.01, 0.005, 0.001)


def test_beyond_a_fisheyes_image_nothing_counts(tmp_path):
    """theta - 0.1 theta^3 has its maximum at a radius of 1.217, 24.3 px; a mask of the user applies as well."""
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


@pytest.mark.parametrize(
    "source",
    [
        "from clsplat.dataset.lenses import camera_models as load",
        "from clsplat.dataset import load_scene; load = lambda: load_scene(Path(sys.argv[1]), DataConfig())",
    ],
)
def test_models_of_cameras_leave_signals_to_python(root, source):
    """pycolmap, which knows the models, would print a stack trace after SIGTERM; photos are decoded in threads."""
    rows = {"frames": frames(), "fl_x": 50, "w": 64.0, "h": 48.0, "k1": 0.1}
    (root / "transforms.json").write_text(json.dumps(rows))
    program = f"""
import os, signal, sys
from pathlib import Path
from clsplat.config import DataConfig
signal.signal(signal.SIGTERM, lambda *_: sys.exit(3))
{source}
load()
assert "pycolmap" in sys.modules
os.kill(os.getpid(), signal.SIGTERM)
"""
    ended = subprocess.run([sys.executable, "-c", program, root], capture_output=True, text=True)
    assert ended.returncode == 3 and "Aborted at" not in ended.stderr
