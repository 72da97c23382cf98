"""PLY: the original layout byte by byte, files of other programs, and damaged files."""

import errno
import re
import struct

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.formats import load_gaussians
from clsplat.formats.ply import REQUIRED, load_ply, save_ply
from clsplat.formats.validity import LOG_SCALE_MIN, LOGIT_MAX
from clsplat.gaussians import Gaussians

TYPES = {"f4": "float", "f8": "double"}


def random_gaussians(n=7, degree=3, seed=0):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    shapes = {"means": (n, 3), "log_scales": (n, 3), "logit_opacities": (n,), "sh": (n, (degree + 1) ** 2, 3)}
    return Gaussians(quats=quats, **{k: rng.normal(size=s) for k, s in shapes.items()}).astype(np.float32)


def columns_of(gaussians):
    """Values by property name, written by hand from the table of properties."""
    k = gaussians.sh.shape[1]
    columns = {axis: gaussians.means[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"f_dc_{c}": gaussians.sh[:, 0, c] for c in range(3)}
    for c in range(3):
        for j in range(1, k):
            columns[f"f_rest_{c * (k - 1) + j - 1}"] = gaussians.sh[:, j, c]
    columns["opacity"] = gaussians.logit_opacities
    columns |= {f"scale_{i}": gaussians.log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": gaussians.quats[:, i] for i in range(4)}
    return columns


def ply_bytes(columns, encoding="binary_little_endian", dtype="f4", count=None, extra="", newline="\n"):
    """A PLY made without the code under test and without plyfile."""
    order = ">" if "big" in encoding else "<"
    table = np.stack(list(columns.values()), axis=1)
    header = ["ply", f"format {encoding} 1.0", *extra.splitlines()]
    header += [f"element vertex {len(table) if count is None else count}"]
    header += [f"property {TYPES[dtype]} {name}" for name in columns]
    text = newline.join([*header, "end_header", ""]).encode()
    if encoding == "ascii":
        return text + "".join(" ".join(repr(float(x)) for x in row) + newline for row in table).encode()
    return text + table.astype(order + dtype).tobytes()


def assert_equal(found, expected):
    for name, array in expected.arrays().items():
        assert getattr(found, name).dtype == np.float32
        np.testing.assert_array_equal(getattr(found, name), array, err_msg=name)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "scene.ply"


def test_the_layout_is_the_originals(path):
    gaussians = random_gaussians(n=2)
    save_ply(path, gaussians)
    header, body = path.read_bytes().split(b"end_header\n")
    expected = ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(45)] + ["opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    assert header.decode().splitlines() == expected + [f"property float {name}" for name in names]
    row = dict(zip(names, struct.unpack_from("<62f", body, 62 * 4), strict=True))
    assert len(body) == 2 * 62 * 4
    assert row.pop("nx") == row.pop("ny") == row.pop("nz") == 0
    assert row == {name: values[1] for name, values in columns_of(gaussians).items()}


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_reads_by_name_whatever_the_encoding(path, encoding, dtype, newline):
    gaussians = random_gaussians(degree=1)
    columns = columns_of(gaussians) | {"confidence": np.arange(7.0), "f_extra": np.ones(7)}
    shuffled = dict(np.random.default_rng(1).permutation(np.array(list(columns.items()), dtype=object)))
    path.write_bytes(ply_bytes(shuffled, encoding, dtype, newline=newline))
    found, mode, _ = load_ply(path)
    assert_equal(found, gaussians)
    assert mode == "classic"


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_other_elements_and_comments_are_passed_over(path, encoding):
    gaussians = random_gaussians(degree=0)
    extra = "comment Größe … SplatRenderMode\nelement camera 2\nproperty uchar id\nproperty double t"
    head, body = ply_bytes(columns_of(gaussians), encoding, extra=extra).split(b"end_header\n", 1)
    before = b"1 0.5\n2 0.25\n" if encoding == "ascii" else bytes(18)
    tail = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(head + tail + before + body + (b"3 0 1 2\n" if encoding == "ascii" else bytes(13)))
    assert_equal(load_ply(path)[0], gaussians)


def test_mode_and_offset_travel_as_comments(path):
    offset = np.array([500123.25, 5.6e6 + 0.1, -1e-9])
    save_ply(path, random_gaussians(), "antialiased", offset)
    header = path.read_bytes().split(b"end_header")[0].decode()
    assert "\ncomment SplatRenderMode: mip\n" in header
    assert "\ncomment offset 500123.25 5600000.1 -1e-09\n" in header
    _, mode, found = load_ply(path)
    assert mode == "antialiased" and np.array_equal(found, offset)


def test_comments_of_others_are_no_offset(path):
    extra = (
        "comment offset of the scene unknown\ncomment offset 1 2\ncomment offset 1 nan 3\ncomment SplatRenderMode: x"
    )
    path.write_bytes(ply_bytes(columns_of(random_gaussians()), extra=extra))
    _, mode, offset = load_ply(path)
    assert mode == "classic" and not offset.any()


def test_quaternions_are_normalised_both_ways(path):
    gaussians = random_gaussians(n=3, degree=0)
    unit = gaussians.quats.copy()
    gaussians.quats *= np.array([[3.0], [1e-3], [1e-9]], dtype=np.float32)
    path.write_bytes(ply_bytes(columns_of(gaussians)))
    read = load_ply(path)[0].quats
    save_ply(path, gaussians)
    written = load_ply(path)[0].quats
    # 3 ulp: the factor, the quotient and the unit quaternion itself are rounded.
    np.testing.assert_allclose(read[:2], unit[:2], rtol=4e-7)
    np.testing.assert_array_equal(written, read)
    assert not read[2].any(), "below QUAT_NORM2_MIN the renderer finds no direction"


def test_infinities_with_a_meaning_become_finite(path):
    columns = columns_of(random_gaussians(n=3, degree=0))
    columns["opacity"] = np.array([np.inf, -np.inf, 1.0])
    columns["scale_2"] = np.array([0.0, -np.inf, 1.0])
    path.write_bytes(ply_bytes(columns))
    found = load_ply(path)[0]
    assert found.logit_opacities.tolist() == [LOGIT_MAX, -LOGIT_MAX, 1.0]
    assert found.log_scales[:, 2].tolist() == [0.0, LOG_SCALE_MIN, 1.0]
    assert found.opacities[0] == 1 and found.scales[1, 2] ** 2 > 0


def test_the_shortest_text(path):
    content = ply_bytes({name: np.ones(1) for name in REQUIRED}, "ascii")
    path.write_bytes(content.replace(b"1.0", b"1").replace(b"format ascii 1\n", b"format ascii 1.0\n")[:-1])
    assert load_ply(path)[0].means.tolist() == [[1, 1, 1]]


def broken_files():
    good = columns_of(random_gaussians())
    binary = ply_bytes(good)
    without = {k: v for k, v in good.items() if k not in ("opacity", "rot_2")}
    fewer = {k: v for k, v in good.items() if k not in ("f_rest_44", "f_rest_43", "f_rest_42")}
    gap = {k: v for k, v in good.items() if k not in ("f_rest_7",)}
    nan = good | {"scale_1": np.array([0, 0, np.nan, 0, 0, 0, 0])}
    points = {name: np.zeros(7) for name in ("x", "y", "z", "red")}
    packed = {f"packed_{name}": np.zeros(2) for name in ("position", "rotation", "scale", "color")}
    face = b"element face 0\nproperty list uchar int vertex_indices\nend_header"
    listed = "element face 3\nproperty list uchar int vertex_indices"
    few = ply_bytes(good, "ascii", extra="comment " + "x" * 40_000)
    return {
        "empty": (b"", "first line is 'ply', found b''"),
        "png": (b"\x89PNG\r\n\x1a\n" + bytes(99), "expected a PLY file"),
        "no end": (binary[:200], "'end_header'"),
        "huge": (ply_bytes(good, count=10**15), "declares, found"),
        "huge ascii": (ply_bytes(good, "ascii", count=10**15), "declares, found"),
        "longer than int64": (ply_bytes(good, count=10**30), "declares, found"),
        "truncated": (binary[:-1], f"expected at least {len(binary)} bytes .* found {len(binary) - 1}"),
        "truncated ascii": (few[: few.rindex(b"\n", 0, -1) + 1], "7 rows of 59 numbers, found"),
        "short row": (ply_bytes(good, "ascii")[:-30], "expected rows of 59 numbers"),
        "word": (ply_bytes(good, "ascii")[:-4] + b"abc\n", "expected rows of 59 numbers"),
        "negative": (ply_bytes(good, count=-1), "negative"),
        "no number": (ply_bytes(good, count="many"), "malformed"),
        "type": (binary.replace(b"property float x", b"property real x"), "malformed"),
        "twice": (binary.replace(b"property float y", b"property float x"), "malformed"),
        "encoding": (binary.replace(b"binary_little_endian", b"binary"), "malformed"),
        "lists": (ply_bytes(good, extra=listed), "list property"),
        "no vertex": (binary.replace(b"element vertex", b"element point"), "'vertex', found point"),
        "none": (ply_bytes({k: v[:0] for k, v in good.items()}), "at least one Gaussian"),
        "missing": (ply_bytes(without), r"missing opacity, rot_2 among x, y, z"),
        "42": (ply_bytes(fewer), r"0, 9, 24, 45 properties f_rest_\* .* found 42"),
        "gap": (ply_bytes(gap), "missing f_rest_7 among"),
        "nan": (ply_bytes(nan), "scale_1 = nan in Gaussian 2 .1 of 7"),
        "nan ascii": (ply_bytes(nan, "ascii"), "scale_1 = nan in Gaussian 2"),
        "overflow": (ply_bytes(good | {"y": np.full(7, 1e300)}, dtype="f8"), r"y = inf in Gaussian 0 .7 of 7"),
        "points": (ply_bytes(points), "point cloud of 7 points"),
        "mesh": (ply_bytes(points).replace(b"end_header", face), "mesh of 7 points"),
        "packed": (ply_bytes(packed), "compressed PLY of PlayCanvas"),
    }


@pytest.mark.parametrize("case", broken_files())
def test_a_broken_file_is_one_sentence(path, case):
    content, message = broken_files()[case]
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_ply(path)
    text = str(caught.value)
    assert text.startswith((f"{path}: ", f"cannot read {path}: ")) and len(text.splitlines()) == 1


def test_every_truncation_is_an_input_error(path):
    for encoding in ("binary_little_endian", "ascii"):
        content = ply_bytes(columns_of(random_gaussians(n=2, degree=0)), encoding)
        # An ASCII file cut within its last number is a valid file with another number.
        for size in range(content.rindex(b" ") if encoding == "ascii" else len(content)):
            path.write_bytes(content[:size])
            with pytest.raises(InputError, match=re.escape(str(path))):
                load_ply(path)


def test_files_that_cannot_be_read(tmp_path):
    for path in (tmp_path / "missing.ply", tmp_path):
        with pytest.raises(InputError, match=re.escape(f"cannot read {path}: ")):
            load_ply(path)
    with pytest.raises(InputError, match=r"\*\.ply, .* found suffix '\.txt'"):
        load_gaussians(tmp_path / "a.txt")


@pytest.mark.parametrize("name", random_gaussians().arrays())
def test_nothing_is_written_that_could_not_be_read(path, name):
    gaussians = random_gaussians()
    getattr(gaussians, name)[3] = np.nan
    with pytest.raises(InputError, match="in Gaussian 3"):
        save_ply(path, gaussians)
    with pytest.raises(InputError, match="at least one"):
        save_ply(path, random_gaussians(n=0))
    with pytest.raises(InputError, match="offset"):
        save_ply(path, random_gaussians(), offset=[0, 0, np.inf])
    large = random_gaussians().astype(np.float64)
    large.means[0, 1] = 1e39
    with pytest.raises(InputError, match="y = inf in Gaussian 0"):
        save_ply(path, large)
    assert not list(path.parent.iterdir())


def test_a_failed_write_leaves_the_old_file(path, monkeypatch):
    save_ply(path, random_gaussians())
    before = path.read_bytes()

    def full(path, gaussians):  # the header is written before
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("clsplat.formats.ply.table_of", full)
    with pytest.raises(InputError, match=f"{re.escape(str(path))}.*No space left"):
        save_ply(path, random_gaussians(seed=1))
    assert path.read_bytes() == before and list(path.parent.iterdir()) == [path]
    monkeypatch.undo()
    with pytest.raises(InputError, match="No such file"):
        save_ply(path.parent / "missing" / "scene.ply", random_gaussians())


def test_plyfile_reads_what_is_written(path):
    plyfile = pytest.importorskip("plyfile")
    gaussians = random_gaussians()
    save_ply(path, gaussians)
    vertex = plyfile.PlyData.read(path)["vertex"]
    for name, values in columns_of(gaussians).items():
        np.testing.assert_array_equal(vertex[name], values, err_msg=name)
    assert set(REQUIRED) <= set(columns_of(gaussians))
