"""The .ksplat of GaussianSplats3D: by hand, and broken files. Files of its own library: test_made_by_others.py."""

import numpy as np
import pytest
from bounds import matched, random_gaussians
from foreign_code import splat_transform, write_ksplat

from clsplat.errors import InputError
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.formats.ksplat import HEADER, SECTION, load_ksplat


def scene(level=1, counts=((5, 2),), **changes):
    """A file: per section the Gaussians and the size of a bucket; the last bucket is partial."""
    header = np.zeros(1, HEADER)
    header["minor"], header["level"] = 1, level
    header["sections"], header["count"] = len(counts), sum(count for count, _ in counts)
    header["sh_low"], header["sh_high"] = changes.pop("sh", (0, 0))
    sections, parts = np.zeros(len(counts), SECTION), []
    for section, (count, bucket) in zip(sections, counts, strict=True):
        full = count // bucket
        partial = np.full(int(count % bucket > 0), count % bucket, "<u4")
        section["count"], section["room"], section["bucket"] = count, count + 1, bucket
        section["buckets"], section["full"], section["partial"] = full + len(partial), full, len(partial)
        section["block"], section["centre"], section["degree"] = 4.0, 12, 1
        centres = np.arange(3 * section["buckets"], dtype="<f4")
        shape, sh = ("<f2", "<f2" if level == 1 else "u1") if level else ("<f4", "<f4")
        place = "<u2" if level else "<f4"
        row = [("means", place, 3), ("scales", shape, 3), ("quats", shape, 4), ("rgba", "u1", 4), ("sh", sh, 9)]
        rows = np.zeros(count + 1, row)
        rows["means"] = 32767 if level else 1
        rows["means"][:, 0] += 16384 if level else 0
        rows["scales"], rows["quats"][:, 0], rows["rgba"] = [1, 0.5, 0], 2, [0, 255, 51, 51]
        rows["sh"] = np.arange(9)
        parts += [partial.tobytes(), centres.tobytes(), rows.tobytes()]
    for name, value in changes.items():
        (header if name in HEADER.names else sections)[name] = value
    return header.tobytes() + sections.tobytes() + b"".join(parts)


def test_a_file_by_hand(tmp_path):
    path = tmp_path / "a.ksplat"
    path.write_bytes(scene(1, ((5, 2), (1, 2))))
    found, mode, offset = load_ksplat(path)
    # Buckets of 2, 2, 1 Gaussians, and of 1; half of 32767 steps is a quarter of the side of 4.
    centres = np.array([[0, 1, 2], [0, 1, 2], [3, 4, 5], [3, 4, 5], [6, 7, 8], [0, 1, 2]])
    np.testing.assert_allclose(found.means, centres + np.array([1, 0, 0]), atol=1e-4)
    np.testing.assert_allclose(found.scales, np.tile([[1, 0.5, 0]], (6, 1)), atol=1e-6)
    np.testing.assert_array_equal(found.quats, np.tile([[1, 0, 0, 0]], (6, 1)))
    np.testing.assert_allclose(found.opacities, 0.2, rtol=1e-6)
    np.testing.assert_allclose(found.sh[0, 0] * 0.28209479 + 0.5, [0, 1, 0.2], atol=1e-6)
    np.testing.assert_array_equal(found.sh[0, 1:], np.arange(9).reshape(3, 3).T)  # channel by channel
    assert mode == "classic" and not offset.any()


@pytest.mark.parametrize(("ends", "low", "high"), [((0, 0), -1.5, 1.5), ((-2, 4), -2, 4)])
def test_bytes_of_the_harmonics_have_a_range(tmp_path, ends, low, high):
    (tmp_path / "a.ksplat").write_bytes(scene(2, sh=ends))
    sh = load_ksplat(tmp_path / "a.ksplat")[0].sh[0, 1:]
    np.testing.assert_allclose(sh.T.ravel(), low + np.arange(9) / 255 * (high - low), atol=1e-6)


def test_sections_of_different_degrees(tmp_path):
    content = scene(0, ((2, 4), (2, 4)))
    sections = np.frombuffer(content, SECTION, 2, HEADER.itemsize).copy()
    sections["degree"][1] = 0
    rows = content[HEADER.itemsize + sections.nbytes :]
    middle, row = len(rows) // 2, 44 + 36
    flat = rows[middle : -3 * row] + b"".join(rows[-k * row :][:44] for k in (3, 2, 1))
    (tmp_path / "a.ksplat").write_bytes(content[: HEADER.itemsize] + sections.tobytes() + rows[:middle] + flat)
    found = load_ksplat(tmp_path / "a.ksplat")[0]
    assert found.sh.shape == (4, 4, 3) and found.sh[:2, 1:].any() and not found.sh[2:, 1:].any()


BROKEN = {
    "major": ({"major": 1}, "found version 1.1 with level 1"),
    "minor": ({"minor": 0}, "found version 0.0"),
    "level": ({}, "version 0.1 with level 3"),
    "none": ({"count": 0}, "found 5"),
    "more": ({"count": 6}, "expected 6 Gaussians as the header declares, at least one, found 5"),
    "sections": ({"sections": 2**32 - 1}, "expected 4294967295 sections"),
    "room": ({"room": 2**32 - 1}, "the file is truncated or damaged"),
    "less room": ({"room": 4}, "expected 5 Gaussians"),
    "buckets": ({"buckets": 2**32 - 1}, "the file is truncated or damaged"),
    "partial": ({"partial": 2**32 - 1}, "the file is truncated or damaged"),
    "full": ({"full": 5, "bucket": 1}, "a bucket for each of 5 Gaussians, found 3 buckets for 6"),
    "no bucket": ({"full": 0, "bucket": 0}, "a bucket for each of 5 Gaussians, found 3 buckets for 1"),
    "degree": ({"degree": 3}, "degree 0 to 2 and 12 bytes per bucket, found 3"),
    "centre": ({"centre": 8}, "found 1 and 8"),
    "block": ({"block": np.inf}, "expected finite values, found means"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_one_sentence(tmp_path, case):
    changes, message = BROKEN[case]
    path = tmp_path / "a.ksplat"
    content = bytearray(scene(1, **changes))
    content[20] = 3 if case == "level" else content[20]  # no row of it is known to write
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_ksplat(path)
    assert str(caught.value).startswith(f"{path}: ") and len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("level", [0, 1, 2])
def test_no_truncated_file_is_taken(tmp_path, level):
    content = scene(level)
    for size in (0, 1, 4095, 4096, 5119, 5120, len(content) - 1):
        (tmp_path / "a.ksplat").write_bytes(content[:size])
        with pytest.raises(InputError, match=r"a\.ksplat"):
            load_ksplat(tmp_path / "a.ksplat")


def test_clsplat_does_not_write_it(tmp_path):
    with pytest.raises(InputError, match=r"found \.ksplat, which it only reads; use \.spz"):
        save_gaussians(tmp_path / "a.ksplat", random_gaussians(3))
    with pytest.raises(InputError, match="No such file"):
        load_gaussians(tmp_path / "a.ksplat")


@pytest.mark.foreign
@pytest.mark.parametrize("level", [0, 1, 2])
def test_two_readers_of_a_file_of_its_library_agree(tmp_path, level):
    source = random_gaussians(2000, 2)
    source.means *= 10
    save_gaussians(tmp_path / "a.ply", source)
    write_ksplat(tmp_path / "a.ply", tmp_path / "a.ksplat", level, 2)
    splat_transform(tmp_path / "a.ksplat", tmp_path / "theirs.ply")
    ours = matched(load_ksplat(tmp_path / "a.ksplat")[0], source)
    theirs = matched(load_gaussians(tmp_path / "theirs.ply")[0], source)
    np.testing.assert_allclose(ours.means, theirs.means, atol=1e-5)
    np.testing.assert_allclose(ours.log_scales, theirs.log_scales, atol=1e-5)
    np.testing.assert_allclose(ours.sh, theirs.sh, atol=1e-5)
    np.testing.assert_allclose(ours.opacities, theirs.opacities, atol=2e-6)
    assert np.abs(ours.means - source.means).max() < 1e-3
