"""Every format of `FORMATS`: stated quantisation, warnings about what is lost, refusal of damaged files."""

import errno
import re
import warnings

import numpy as np
import pytest
from bounds import BOUNDS, HOLDS, assert_within, matched, random_gaussians, save

from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.formats import FORMATS, load_gaussians, quantisation, save_gaussians, suffix_of
from clsplat.formats.validity import LOGIT_MAX
from clsplat.gaussians import Gaussians

EACH_FORMAT = pytest.mark.parametrize("suffix", FORMATS)
COMPACT = [suffix for suffix in FORMATS if any(np.any(bound) for bound in BOUNDS[suffix](random_gaussians()))]


def without_sh(gaussians):
    return Gaussians(**gaussians.arrays() | {"sh": gaussians.sh[:, :1]})


@EACH_FORMAT
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [1, 2, 255, 1000])
def test_every_format_round_trips(tmp_path, suffix, degree, n):
    gaussians = random_gaussians(n, degree)
    path, again = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    said = save(path, gaussians)
    found, mode, offset = load_gaussians(path)
    if "sh" not in HOLDS[suffix] and degree:
        assert f"degree {degree} is cut to 0" in said
        gaussians = without_sh(gaussians)
    else:
        assert not said
    assert_within(matched(found, gaussians), gaussians, BOUNDS[suffix](gaussians))
    assert mode == "classic" and not offset.any()
    # Identical input, identical bytes, and nothing else is left.
    save(again, random_gaussians(n, degree))
    assert path.read_bytes() == again.read_bytes()
    assert sorted(tmp_path.iterdir()) == [path, again]


@EACH_FORMAT
def test_mode_and_offset_survive_or_are_mourned(tmp_path, suffix):
    path, shift = tmp_path / f"a{suffix}", np.array([500123.25, 5.6e6 + 0.1, -1e-9])
    said = save(path, random_gaussians(degree=0), "antialiased", shift)
    _, mode, offset = load_gaussians(path)
    assert ("mode of the scene, antialiased" in said, mode) == (
        (False, "antialiased") if "mode" in HOLDS[suffix] else (True, "classic")
    )
    assert ("5600000.1" in said) == ("offset" not in HOLDS[suffix])
    assert np.array_equal(offset, shift if "offset" in HOLDS[suffix] else np.zeros(3))


@pytest.mark.parametrize(
    ("suffix", "field", "value", "count", "held"),
    [
        (".splat", "sh", 30.0, 1, 0.5 / SH_C0),
        (".spz", "sh", 30.0, 1, 127.5 / 38.25),
        (".spz", "sh", -30.0, 1, -127.5 / 38.25),
        (".spz", "log_scales", -12.0, 1, -10.0),
        (".spz", "log_scales", 9.0, 1, 5.9375),
        (".compressed.ply", "log_scales", -39.0, 1, -20.0),
        (".compressed.ply", "log_scales", 25.0, 1, 20.0),
    ],
)
def test_what_is_cut_off_is_counted(tmp_path, suffix, field, value, count, held):
    gaussians = random_gaussians(300, degree=0)
    getattr(gaussians, field).reshape(300, -1)[7] = value
    path = tmp_path / f"a{suffix}"
    said = save(path, gaussians)
    assert len(re.findall("clamped", said)) == 1 and f"of {count} of 300 Gaussians" in said
    found = matched(load_gaussians(path)[0], gaussians)
    np.testing.assert_allclose(getattr(found, field).reshape(300, -1)[7], held, rtol=1e-5)


@pytest.mark.parametrize(("suffix", "limit"), [(".spz", 1.0), (".compressed.ply", 4.0)])
def test_higher_bands_are_clamped_and_counted(tmp_path, suffix, limit):
    gaussians = random_gaussians(300)
    gaussians.sh[:5, 3, 1] = 1.5 * limit
    gaussians.sh[5:8, 15, 2] = -1.5 * limit
    path = tmp_path / f"a{suffix}"
    assert "sh above band 0 of 8 of 300" in save(path, gaussians)
    found = matched(load_gaussians(path)[0], gaussians)
    np.testing.assert_allclose(found.sh[:5, 3, 1], limit, rtol=0.01)
    np.testing.assert_allclose(found.sh[5:8, 15, 2], -limit, rtol=0.01)


@EACH_FORMAT
def test_the_ends_of_opacity_and_scale_come_back_finite(tmp_path, suffix):
    gaussians = random_gaussians(3, degree=0)
    gaussians.logit_opacities[:] = [100, -100, 0]
    gaussians.log_scales[0] = -40
    save(tmp_path / f"a{suffix}", gaussians)
    found = matched(load_gaussians(tmp_path / f"a{suffix}")[0], gaussians)
    np.testing.assert_allclose(found.opacities, [1, 0, 0.5], atol=1 / 510 + 1e-6)
    if suffix in COMPACT:
        assert list(found.logit_opacities[:2]) == [LOGIT_MAX, -LOGIT_MAX]
    assert (found.log_scales[0] <= -10).all()


@pytest.mark.parametrize("suffix", COMPACT)
def test_what_has_no_orientation_stays_invisible(tmp_path, suffix):
    gaussians = random_gaussians(3, degree=0)
    gaussians.quats[1] = 1e-9
    save(tmp_path / f"a{suffix}", gaussians)
    found = matched(load_gaussians(tmp_path / f"a{suffix}")[0], gaussians)
    assert found.opacities[1] < 1e-6 and np.isfinite(found.quats).all()


@pytest.mark.parametrize("suffix", COMPACT)
def test_axes_and_signs_of_rotations(tmp_path, suffix):
    """Each component as the largest, with either sign, and ties."""
    q = np.concatenate([np.eye(4), -np.eye(4), [[0.5, 0.5, 0.5, 0.5], [0.5, -0.5, 0.5, -0.5], [0, 1, -1, 0]]])
    gaussians = random_gaussians(len(q), degree=0)
    gaussians.quats[:] = q / np.linalg.norm(q, axis=1, keepdims=True)
    save(tmp_path / f"a{suffix}", gaussians)
    found = matched(load_gaussians(tmp_path / f"a{suffix}")[0], gaussians)
    assert_within(found, gaussians, BOUNDS[suffix](gaussians))


@EACH_FORMAT
def test_equal_gaussians_have_no_range(tmp_path, suffix):
    one = random_gaussians(1)
    path = tmp_path / f"a{suffix}"
    save(path, one.take(np.zeros(600, np.intp)))
    found = load_gaussians(path)[0]
    assert len(found) == 600
    if "sh" not in HOLDS[suffix]:
        one = without_sh(one)
    for row in (0, 299, 599):
        assert_within(found.take([row]), one, BOUNDS[suffix](one))


@EACH_FORMAT
@pytest.mark.parametrize("field", random_gaussians(1).arrays())
def test_nothing_is_written_that_could_not_be_read(tmp_path, suffix, field):
    path = tmp_path / f"a{suffix}"
    gaussians = random_gaussians(7)
    getattr(gaussians, field)[3] = np.nan
    with pytest.raises(InputError, match=f"{re.escape(str(path))}.* in Gaussian 3"):
        save_gaussians(path, gaussians)
    large = random_gaussians(7).astype(np.float64)
    getattr(large, field)[2] = 1e300
    if field != "quats":  # a direction, however long
        with pytest.raises(InputError, match="in Gaussian 2"):
            save_gaussians(path, large)
    with pytest.raises(InputError, match="at least one"):
        save_gaussians(path, random_gaussians(0))
    with pytest.raises(InputError, match="offset"):
        save_gaussians(path, random_gaussians(7, degree=0), "classic", [0, 0, np.inf])
    assert not list(tmp_path.iterdir())


@EACH_FORMAT
def test_files_that_cannot_be_reached(tmp_path, suffix):
    for path in (tmp_path / f"missing{suffix}", tmp_path / "no folder" / f"a{suffix}"):
        with pytest.raises(InputError, match=re.escape(f"cannot read {path}: No such file")):
            load_gaussians(path)
    with pytest.raises(InputError, match="No such file"):
        save_gaussians(tmp_path / "no folder" / f"a{suffix}", random_gaussians(2, degree=0))


@EACH_FORMAT
def test_a_failed_write_leaves_the_old_file(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"a{suffix}"
    save(path, random_gaussians(5, degree=0))
    before = path.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(InputError, match=f"{re.escape(str(path))}.*No space left"):
        save_gaussians(path, random_gaussians(5, degree=0, seed=1))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@EACH_FORMAT
def test_no_truncated_file_is_taken(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    save(path, random_gaussians(2, degree=1 if "sh" in HOLDS[suffix] else 0))
    content = path.read_bytes()
    for size in {0, 1, 2, 3, 15, 16, 31, 33, len(content) - 1, *range(0, len(content), 7)}:
        path.write_bytes(content[:size])
        if suffix == ".splat" and size == 32:
            continue  # a valid file with fewer Gaussians
        with pytest.raises(InputError, match=re.escape(str(path))) as caught:
            load_gaussians(path)
        assert len(str(caught.value).splitlines()) == 1
    path.write_bytes(b"")
    with pytest.raises(InputError, match=re.escape(str(path))):
        load_gaussians(path)


@EACH_FORMAT
def test_a_damaged_byte_is_an_input_error_or_harmless(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    save(path, random_gaussians(4, degree=1 if "sh" in HOLDS[suffix] else 0))
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    taken = 0
    for position in rng.permutation(len(content))[:300]:
        damaged = bytearray(content)
        damaged[position] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = load_gaussians(path)[0]
        except InputError as error:
            assert str(error).startswith((f"{path}: ", f"cannot read {path}"))
        else:
            taken += 1
            assert len(found) and all(np.isfinite(array).all() for array in found.arrays().values())
    if suffix in (".spz", ".sog"):  # they carry sums
        assert taken < 30


@pytest.mark.parametrize("suffix", [suffix for suffix in FORMATS if suffix != ".ply"])
def test_files_of_another_format(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    save(tmp_path / "a.ply", random_gaussians(3, degree=0))
    for content in (b"\x89PNG\r\n\x1a\n" + bytes(999), b"PK\x03\x04" + bytes(333), (tmp_path / "a.ply").read_bytes()):
        path.write_bytes(content[: len(content) // 32 * 32 + 1])
        with pytest.raises(InputError, match=rf"{re.escape(str(path))}: expected|cannot read {re.escape(str(path))}"):
            load_gaussians(path)


def test_the_longest_suffix_counts(tmp_path):
    assert suffix_of("a.b.compressed.ply") == suffix_of("A.COMPRESSED.PLY") == ".compressed.ply"
    assert suffix_of("compressed.ply") == ".ply" and suffix_of("a.ply.gz") == suffix_of(".spz") == ""
    path = tmp_path / "scene.ply"
    save(tmp_path / "a.compressed.ply", random_gaussians(3))
    (tmp_path / "a.compressed.ply").rename(path)
    with pytest.raises(InputError, match=r"rename it to \*\.compressed\.ply"):
        load_gaussians(path)


def test_an_expansion_beyond_any_scene_is_refused(monkeypatch):
    quantisation.check_expansion("a", quantisation.EXPANSION_FREE, 1)
    quantisation.check_expansion("a", 100 * quantisation.EXPANSION_FREE, quantisation.EXPANSION_FREE)
    with pytest.raises(InputError, match="exhaust memory"):
        quantisation.check_expansion("a", 100 * quantisation.EXPANSION_FREE + 1, quantisation.EXPANSION_FREE)


@pytest.mark.parametrize("suffix", [".compressed.ply", ".spz", ".sog"])
def test_neighbours_follow_each_other(tmp_path, suffix):
    gaussians = random_gaussians(1000, degree=0)
    save(tmp_path / f"a{suffix}", gaussians)
    found = load_gaussians(tmp_path / f"a{suffix}")[0]
    before, after = (np.linalg.norm(np.diff(g.means, axis=0), axis=1).mean() for g in (gaussians, found))
    assert after < before / 3


def test_morton_order_keeps_neighbours_together():
    rng = np.random.default_rng(0)
    points = rng.permutation(np.stack(np.meshgrid(*3 * [np.arange(8.0)]), axis=-1).reshape(-1, 3))
    ordered = points[quantisation.morton_order(points)].astype(int)
    # The code's bits are those of z, y, x in turn.
    codes = [sum((p[axis] >> bit & 1) << (3 * bit + axis) for axis in range(3) for bit in range(3)) for p in ordered]
    assert codes == sorted(codes) and ordered[1].tolist() == [1, 0, 0] and ordered[4].tolist() == [0, 0, 1]
    assert sorted(quantisation.morton_order(np.zeros((5, 3)))) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("suffix", "size"),
    [
        (".ply", "ply_container.check_size"),
        (".compressed.ply", "compressed_ply.check_length"),
        (".splat", "splat.file_size"),
    ],
)
def test_a_file_that_gives_fewer_bytes_than_its_size_is_refused(tmp_path, monkeypatch, suffix, size):
    """A failing disk ends a read early. `numpy.fromfile` then returns the rows until there, as if they were all."""
    path = tmp_path / f"a{suffix}"
    save(path, random_gaussians(100, 0))
    whole = path.stat().st_size
    with path.open("r+b") as file:
        file.truncate(whole - 32)
    monkeypatch.setattr(f"clsplat.formats.{size}", lambda *_: whole)
    with pytest.raises(InputError, match=r"a\..*: expected \d+ more bytes, found \d+; the file is truncated"):
        load_gaussians(path)
