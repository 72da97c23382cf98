"""Coarse to fine: which iteration sees which size, and that a smaller photo is the same view."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.config import CoarseConfig, TrainConfig
from clsplat.scene import View
from clsplat.training.coarse_to_fine import factor_at, shrunk


@pytest.mark.parametrize(
    ("factor", "until", "expected"),
    [
        (1, 0.5, [(1, 1), (40, 1)]),
        (4, 0.5, [(1, 4), (10, 4), (11, 2), (20, 2), (21, 1), (40, 1)]),
        (8, 0.75, [(10, 8), (11, 4), (20, 4), (21, 2), (30, 2), (31, 1)]),
        (2, 0, [(1, 1), (40, 1)]),
        (2, 1, [(1, 2), (40, 2)]),
    ],
)
def test_the_factor_is_halved_at_equal_intervals(factor, until, expected):
    config = TrainConfig(iterations=40, coarse=CoarseConfig(factor=factor, until=until))
    assert [(i, factor_at(i, config)) for i, _ in expected] == expected


def view(width: int, height: int) -> View:
    rng = np.random.default_rng(0)
    camera = Camera.look_at([0.3, 0.2, -3], [0, 0, 0], [0, -1, 0], 1.1 * width, width, height)
    camera = replace(camera, cx=0.45 * width, fy=0.9 * camera.fy)
    return View("a.png", camera, rng.integers(0, 256, (height, width, 3), dtype=np.uint8))


def test_nothing_happens_at_full_size():
    full = view(12, 8)
    assert shrunk(full, 1) is full


def test_pixels_are_means_of_boxes():
    full = view(12, 8)
    small = shrunk(full, 4)
    boxes = full.image.reshape(2, 4, 3, 4, 3).mean(axis=(1, 3))
    # To the nearest of 8 bits.
    np.testing.assert_allclose(small.image, boxes, atol=0.5 + 1e-6)
    assert small.image.dtype == np.uint8
    assert small.name == full.name


@pytest.mark.parametrize("size", [(12, 8), (13, 7), (3, 1)])
@pytest.mark.parametrize("factor", [2, 4, 8])
def test_a_point_is_seen_at_the_same_place_of_the_photo(size, factor):
    full = view(*size)
    small = shrunk(full, factor)
    assert small.image.shape == (small.camera.height, small.camera.width, 3)
    assert abs(small.camera.width - size[0] / factor) <= 0.5 or small.camera.width == 1

    def place(camera: Camera) -> np.ndarray:
        p = camera.viewmat[:3, :3] @ [0.1, -0.2, 0.4] + camera.viewmat[:3, 3]
        return (camera.K @ p)[:2] / p[2] / [camera.width, camera.height]

    np.testing.assert_allclose(place(small.camera), place(full.camera), rtol=1e-12)
    np.testing.assert_array_equal(small.camera.viewmat, full.camera.viewmat)


def test_a_pixel_counts_where_all_of_its_box_does():
    mask = np.ones((8, 12), bool)
    mask[0, 0] = mask[5, 7] = False
    small = shrunk(replace(view(12, 8), mask=mask), 4)
    np.testing.assert_array_equal(small.mask, [[False, True, True], [True, False, True]])
    assert small.mask.dtype == bool
    assert shrunk(view(12, 8), 4).mask is None
