"""Pictures of an evaluation, read back from their files."""

import numpy as np
import pytest
from PIL import Image

from clsplat.errors import InputError
from clsplat.show.comparisons import DIFFERENCE_MAX, save_difference, save_png, side_by_side


def read(path):
    return np.array(Image.open(path).convert("RGB"))


def test_png_is_the_image(tmp_path):
    image = np.random.default_rng(0).uniform(size=(5, 7, 3))
    save_png(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read(tmp_path / "a.png"), np.rint(image * 255))


def test_difference_is_the_mean_of_the_channels_on_its_scale(tmp_path):
    from matplotlib import colormaps

    truth = np.full((1, 5, 3), 100, np.uint8)
    image = truth.copy()
    image[0, 1] += np.array([30, 0, 0], np.uint8)  # a mean of 10
    image[0, 2] -= 51  # the end of the scale
    image[0, 3] += 140
    image[0, 4] += 140
    save_difference(tmp_path / "d.png", image, truth, np.array([[True, True, True, True, False]]))
    share = np.minimum(np.array([0, 10, 51, 140, 0]) / 255 / DIFFERENCE_MAX, 1)
    expected = colormaps["magma"](share, bytes=True)[:, :3].astype(int)
    # One of the map's 256 steps.
    np.testing.assert_allclose(read(tmp_path / "d.png")[0].astype(int), expected, atol=4)
    assert np.array_equal(read(tmp_path / "d.png")[0, 0], read(tmp_path / "d.png")[0, 4])


def test_side_by_side_shows_both_pictures(tmp_path):
    rng = np.random.default_rng(0)
    pairs = [
        (rng.integers(0, 256, (h, w, 3), dtype=np.uint8), rng.uniform(size=(h, w, 3))) for h, w in [(20, 30), (9, 50)]
    ]
    side_by_side(tmp_path / "s.png", pairs)
    sheet = read(tmp_path / "s.png")
    assert sheet.shape == (28 + 20 + 8 + 9 + 8, 8 + 50 + 8 + 50 + 8, 3)
    top = 28
    for photo, render in pairs:
        h, w = photo.shape[:2]
        np.testing.assert_array_equal(sheet[top : top + h, 8 : 8 + w], photo)
        np.testing.assert_array_equal(sheet[top : top + h, 66 : 66 + w], np.rint(render * 255))
        top += h + 8
    assert (sheet[:28] < 128).any(), "labels"
    with pytest.raises(InputError, match="pairs"):
        side_by_side(tmp_path / "s.png", [])
