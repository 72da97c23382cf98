"""Intrinsics in transforms.json: of frames and of files, focal lengths, distortion, smaller copies."""

import dataclasses
import json

import numpy as np
import pytest
from test_transforms import NAMES, frames, intrinsics_of, write, write_photos

from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.dataset.lenses import Intrinsics
from clsplat.dataset.transforms import read_dataset
from clsplat.errors import InputError


def test_frames_have_intrinsics_of_their_own(root):
    rows = frames()
    rows[0] |= {"fl_x": 70, "fl_y": 71, "cx": 30, "cy": 20}
    (root / "transforms.json").write_text(json.dumps({"frames": rows, "fl_x": 50, "w": 64.0, "h": 48.0}))
    first, second, *_ = (photo.intrinsics for photo in read_dataset(root, DataConfig()).photos)
    assert first == Intrinsics("PINHOLE", (70, 71, 30, 20), 64, 48)
    assert second == Intrinsics("PINHOLE", (50, 50, 32, 24), 64, 48)


@pytest.mark.parametrize(
    ("whole", "own", "expected"),
    [
        ({"fl_x": 50}, {"camera_angle_x": 2 * np.arctan(0.5)}, Intrinsics("PINHOLE", (64, 64, 32, 24), 64, 48)),
        (
            {"camera_angle_x": 1, "camera_angle_y": 0.8},
            {"fl_x": 70},
            Intrinsics("PINHOLE", (70, 70, 32, 24), 64, 48),
        ),
        (
            {"fl_x": 50, "k1": 0.1, "k2": 0.2},
            {"k1": 0.3},
            Intrinsics("FULL_OPENCV", (50, 50, 32, 24, 0.3, *[0] * 7), 64, 48),
        ),
        (
            {"fl_x": 50, "camera_model": "OPENCV", "cx": 33},
            {"is_fisheye": True, "k4": 0.1},
            Intrinsics("OPENCV_FISHEYE", (50, 50, 33, 24, 0, 0, 0, 0.1), 64, 48),
        ),
    ],
    ids=["angle", "focal length", "distortion", "fisheye"],
)
def test_a_frames_own_focal_lengths_and_lens_replace_those_of_the_file(root, whole, own, expected):
    rows = frames()
    rows[0] |= own
    (root / "transforms.json").write_text(json.dumps({"frames": rows, **whole}))
    found = intrinsics_of(root)
    np.testing.assert_allclose(found.params, expected.params)
    assert found == dataclasses.replace(expected, params=found.params)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"fl_x": 50, "fl_y": 60}, (50, 60)),
        ({"fl_x": 50}, (50, 50)),
        ({"fl_y": 60}, (60, 60)),
        ({"fl_x": 50, "camera_angle_x": 3.0}, (50, 50)),
        ({"camera_angle_x": 2 * np.arctan(0.5), "camera_angle_y": 2 * np.arctan(0.25)}, (64, 96)),
    ],
)
def test_focal_lengths(root, fields, expected):
    write(root, **fields)
    np.testing.assert_allclose(intrinsics_of(root).params[:2], expected)


@pytest.mark.parametrize(
    ("fields", "model", "coefficients"),
    [
        ({"camera_model": "SIMPLE_PINHOLE", "k1": 0}, "PINHOLE", ()),
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, "FULL_OPENCV", (0.1, 0.2, 0.3, 0.4, 0, 0, 0, 0)),
        ({"camera_model": "OPENCV", "k1": 0.1, "k3": 0.5}, "FULL_OPENCV", (0.1, 0, 0, 0, 0.5, 0, 0, 0)),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.1}, "FULL_OPENCV", (0.1, 0, 0, 0, 0, 0, 0, 0)),
        ({"camera_model": "FULL_OPENCV", "k4": 0.1, "k6": 0.2}, "FULL_OPENCV", (0, 0, 0, 0, 0, 0.1, 0, 0.2)),
        (
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4},
            "OPENCV_FISHEYE",
            (0.1, 0.2, 0.3, 0.4),
        ),
        ({"is_fisheye": True}, "OPENCV_FISHEYE", (0, 0, 0, 0)),
    ],
)
def test_distortion_becomes_a_colmap_model(root, fields, model, coefficients):
    write(root, fl_x=50, **fields)
    assert intrinsics_of(root) == Intrinsics(model, (50, 50, 32, 24, *coefficients), 64, 48)


def test_smaller_copies_keep_the_declared_intrinsics(tmp_path):
    write_photos(tmp_path, [name.replace("images", "images_2") for name in NAMES], (32, 24))
    write(tmp_path, fl_x=50, cx=33, cy=25, w=64, h=48)
    camera = load_scene(tmp_path, DataConfig(downscale=2)).train[0].camera
    assert (camera.fx, camera.cx, camera.cy, camera.width, camera.height) == (25, 16.5, 12.5, 32, 24)
    found = load_scene(tmp_path, DataConfig()).train[0].camera
    assert (found.fx, found.width, found.height) == (25, 32, 24)
    with pytest.raises(InputError, match="downscale 2"):
        load_scene(tmp_path, DataConfig(downscale=1))


@pytest.mark.parametrize("fields", [{"fl_x": 50}, {"camera_angle_x": 2 * np.arctan(32 / 50)}])
def test_intrinsics_without_a_size_belong_to_the_full_size(tmp_path, fields):
    write_photos(tmp_path, [name.replace("images", "images_2") for name in NAMES], (32, 24))
    write(tmp_path, **fields)
    np.testing.assert_allclose(load_scene(tmp_path, DataConfig(downscale=2)).train[0].camera.fx, 25)


def test_reduced_photos_have_reduced_cameras(root):
    write(root, fl_x=50)
    camera = load_scene(root, DataConfig(downscale=4)).train[0].camera
    assert (camera.fx, camera.cx, camera.width, camera.height) == (12.5, 8, 16, 12)
