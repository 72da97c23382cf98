"""The .splat format, on bytes written by hand."""

import struct

import numpy as np
import pytest

from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.formats.splat import load_splat, save_splat
from clsplat.formats.validity import LOG_SCALE_MIN
from clsplat.gaussians import Gaussians

# Quaternions wxyz as 128 q + 128: (0.5, -0.5, 0.5, -0.5) and (0, 0, -1, 0).
LARGE = struct.pack("<6f8B", 1, 2, 3, 0.5, 2, 4, 255, 0, 51, 204, 192, 64, 192, 64)
SMALL = struct.pack("<6f8B", -1, 0, 9, 0.25, 1, 1, 51, 102, 204, 51, 128, 128, 0, 128)


def test_both_ways_by_hand(tmp_path):
    path = tmp_path / "a.splat"
    path.write_bytes(SMALL + LARGE)
    found, mode, offset = load_splat(path)
    np.testing.assert_array_equal(found.means, [[-1, 0, 9], [1, 2, 3]])
    np.testing.assert_allclose(found.scales, [[0.25, 1, 1], [0.5, 2, 4]], rtol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * found.sh[:, 0], [[0.2, 0.4, 0.8], [1, 0, 0.2]], atol=1e-6)
    np.testing.assert_allclose(found.opacities, [0.2, 0.8], rtol=1e-6)
    np.testing.assert_allclose(found.quats, [[0, 0, -1, 0], [0.5, -0.5, 0.5, -0.5]], atol=1e-6)
    assert mode == "classic" and not offset.any()
    save_splat(path, found)
    assert path.read_bytes() == LARGE + SMALL, "large and opaque ones come first"


def test_order_is_volume_times_opacity(tmp_path):
    path = tmp_path / "a.splat"
    scales = np.array([[1, 1, 1], [2, 2, 2], [1, 1, 4], [1, 1, 5]], float)
    logits = np.array([5, -3, 5, -1], float)  # products about 1, 0.38, 4, 1.3
    g = Gaussians(np.arange(12.0).reshape(4, 3), np.log(scales), np.ones((4, 4)), logits, np.zeros((4, 1, 3)))
    save_splat(path, g)
    assert load_splat(path)[0].means[:, 0].tolist() == [6, 9, 0, 3]


def row(x=0.0, scale=1.0):
    return struct.pack("<6f8B", x, 0, 0, 1, scale, 1, *[128] * 4, 255, 128, 128, 128)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "a multiple of 32 bytes, found 0"),
        (row() + b"x", "a multiple of 32 bytes, found 33"),
        (row() + row(x=np.nan), r"found means = .* in Gaussian 1 .1 of 2"),
        (row(scale=-1.0), "found log_scales"),
        (row(scale=np.inf), "found log_scales"),
    ],
)
def test_a_broken_file_is_one_sentence(tmp_path, content, message):
    path = tmp_path / "a.splat"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_splat(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_zero_scale_and_scales_too_large(tmp_path):
    path = tmp_path / "a.splat"
    path.write_bytes(row(scale=0.0))
    gaussians = load_splat(path)[0]
    assert gaussians.log_scales.tolist() == [[0, LOG_SCALE_MIN, 0]]
    gaussians.log_scales[0, 1] = 90
    with pytest.raises(InputError, match="found log_scales = 90"):
        save_splat(path, gaussians)
    assert path.read_bytes() == row(scale=0.0)
