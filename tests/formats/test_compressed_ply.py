"""The compressed PLY: bits written by hand, elements in any order, and damaged headers."""

import struct

import numpy as np
import pytest
from bounds import random_gaussians

from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.formats import save_gaussians
from clsplat.formats.compressed_ply import CHUNK, load_compressed_ply, save_compressed_ply

LOW = [-1.0, 0.0, 2.0, -6.0, -5.0, -4.0]
HIGH = [1.0, 0.0, 4.0, -2.0, -1.0, 0.0]
NAMES = [f"{end}_{a}" for end in ("min", "max") for a in "xyz"]
NAMES += [f"{end}_scale_{a}" for end in ("min", "max") for a in "xyz"]
COLORS = [f"{end}_{a}" for end in ("min", "max") for a in "rgb"]
VALUES = [*LOW[:3], *HIGH[:3], *LOW[3:], *HIGH[3:]]
COLOR_VALUES = [-0.5, 0.0, 0.5, 1.5, 1.0, 0.5]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
# Position: x at its end, y anywhere, z at 1023/2047; quaternion wxyz (0.5, -0.5, 0.5, 0.5) without y, the third;
# log scale: start, end, start; colour: 255, 51, 0; opacity 51.
WORDS = [
    2047 << 21 | 5 << 11 | 1023,
    2 << 30 | 873 << 20 | 150 << 10 | 873,
    0 << 21 | 1023 << 11 | 0,
    255 << 24 | 51 << 16 | 0 << 8 | 51,
]


def ply(colors=True, rest=(), count=1, chunks=1, order="<", text="binary_little_endian", extra="", sh_first=False):
    names, values = (NAMES + COLORS, VALUES + COLOR_VALUES) if colors else (NAMES, VALUES)
    head = [f"element chunk {chunks}", *(f"property float {n}" for n in names)]
    head += [f"element vertex {count}", *(f"property uint {n}" for n in PACKED)]
    body = struct.pack(f"{order}{len(values)}f4I", *values, *WORDS)
    sh = [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(len(rest)))] if rest else []
    head, body = (sh + head, bytes(rest) + body) if sh_first else (head + sh, body + bytes(rest))
    return "\n".join(["ply", f"format {text} 1.0", *extra.splitlines(), *head, "end_header", ""]).encode() + body


def expect(gaussians, colors):
    np.testing.assert_allclose(gaussians.means, [[1, 0, 2 + 2 * 1023 / 2047]], rtol=1e-6)
    np.testing.assert_allclose(gaussians.log_scales, [[-6, -1, -4]])
    # 873/1023 and 150/1023, minus 0.5, times sqrt(2): nearest to ±0.5.
    np.testing.assert_allclose(gaussians.quats, [[0.5, -0.5, 0.5, 0.5]], atol=1e-3)
    np.testing.assert_allclose(gaussians.opacities, [0.2], rtol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * gaussians.sh[:, 0], [colors], atol=1e-6)


def test_bits_by_hand(tmp_path):
    path = tmp_path / "a.compressed.ply"
    path.write_bytes(ply())
    found, mode, offset = load_compressed_ply(path)
    expect(found, [1.5, 0.2, 0.5])
    assert found.sh.shape == (1, 1, 3) and mode == "classic" and not offset.any()


@pytest.mark.parametrize("sh_first", [False, True])
def test_big_endian_no_colour_ranges_harmonics_and_comments(tmp_path, sh_first):
    path = tmp_path / "a.compressed.ply"
    rest = [0, 255, 128, 127, 160, 1, 128, 128, 128]  # red of y, z, x; green; blue
    extra = "comment SplatRenderMode: mip\ncomment offset 1 2 3"
    path.write_bytes(ply(False, rest, order=">", text="binary_big_endian", extra=extra, sh_first=sh_first))
    found, mode, offset = load_compressed_ply(path)
    expect(found, [1.0, 0.2, 0.0])
    np.testing.assert_allclose(found.sh[0, 1:, 0], [-4, 4, 1 / 64])
    np.testing.assert_allclose(found.sh[0, 1:, 1], [-1 / 64, 1 + 1 / 64, -4 + 3 / 64])
    np.testing.assert_allclose(found.sh[0, 1:, 2], 1 / 64)
    assert mode == "antialiased" and offset.tolist() == [1, 2, 3]


def test_what_is_written(tmp_path):
    path = tmp_path / "a.compressed.ply"
    gaussians = random_gaussians(CHUNK + 1, degree=1)
    save_compressed_ply(path, gaussians)
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [*NAMES, *COLORS]
    assert lines[2:21] == ["element chunk 2", *(f"property float {n}" for n in names)]
    assert lines[21:26] == [f"element vertex {CHUNK + 1}", *(f"property uint {n}" for n in PACKED)]
    assert lines[26:] == [f"element sh {CHUNK + 1}", *(f"property uchar f_rest_{i}" for i in range(9))]
    assert len(body) == 2 * 72 + (CHUNK + 1) * (16 + 9)
    # The last chunk has one Gaussian, so that its range is a point: the last one of the Z-order.
    last = np.frombuffer(body, "<f4", 18, 72).reshape(3, 2, 3)
    assert (last[:, 0] == last[:, 1]).all() and last[0, 0] in gaussians.means


def broken_files():
    good = ply()
    nan = ply().replace(struct.pack("<f", 4.0), struct.pack("<f", np.nan))
    return {
        "text": (ply(text="ascii"), "binary compressed PLY .* as text"),
        "huge": (ply(count=10**12, chunks=3906250000), "declares, found"),
        "no chunk": (ply(chunks=0), "a chunk for each 256 Gaussians"),
        "two chunks": (ply(chunks=2), "a chunk for each 256 Gaussians"),
        "none": (ply(count=0, chunks=0), "at least one Gaussian"),
        "truncated": (good[:-1], f"expected at least {len(good)} bytes .* found {len(good) - 1}"),
        "nan": (nan, "found means = .* in Gaussian 0"),
        "lacking": (good.replace(b"packed_scale", b"packed_skale"), "which lack vertex.packed_scale"),
        "a colour": (good.replace(b"max_g", b"max_q"), "which lack chunk.max_g"),
        "types": (good.replace(b"uint packed_scale", b"float packed_scale"), "vertex to be u4"),
        "8 coefficients": (ply(rest=bytes(8)), "8 f_rest"),
        "names of coefficients": (ply(rest=bytes(9)).replace(b"f_rest_8", b"f_rest_9"), "9 f_rest"),
        "another element": (ply(rest=bytes(9)).replace(b"element sh", b"element sj"), "found chunk, vertex, sj"),
    }


@pytest.mark.parametrize("case", broken_files())
def test_a_broken_file_is_one_sentence(tmp_path, case):
    content, message = broken_files()[case]
    path = tmp_path / "a.compressed.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_compressed_ply(path)
    assert str(caught.value).startswith(f"{path}: ") and len(str(caught.value).splitlines()) == 1


def test_a_plain_ply_is_told(tmp_path):
    save_gaussians(tmp_path / "a.ply", random_gaussians(3))
    with pytest.raises(InputError, match="found vertex, which lack chunk"):
        load_compressed_ply(tmp_path / "a.ply")
