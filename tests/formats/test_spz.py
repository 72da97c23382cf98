"""SPZ: bytes written by hand from the description of the format, versions 2 to 4, and false declarations."""

import gzip
import struct
import warnings
from contextlib import nullcontext

import numpy as np
import pytest
import zstandard
from bounds import BOUNDS, assert_within, matched, random_gaussians

from clsplat.errors import InputError
from clsplat.formats import anatomy_of, quantisation
from clsplat.formats.spz import fractional_bits, guessed_axes, load_spz, save_spz
from clsplat.gaussians import Gaussians

HALF = 0.5**0.5
# One Gaussian of degree 1: position (1.5, -2, 0.25) with 8 fractional bits, opacity 51/255, colours 0, log scales
# -5, 0, 5.9375, quaternion xyzw (-HALF, 0, 0, HALF), of which z = HALF is the largest by index; 9 coefficients.
POSITION = struct.pack("<3i", 384, -512, 64)
POSITION = b"".join(POSITION[4 * i : 4 * i + 3] for i in range(3))
OPACITY, COLORS, SCALES = bytes([51]), bytes([128, 127, 0]), bytes([80, 160, 255])
ROTATION = struct.pack("<I", 0 << 30 | (0 << 20) | (0 << 10) | (512 + 511))  # x is the largest, w its negative
REST = bytes(range(120, 129))
BODY = POSITION + OPACITY + COLORS + SCALES + ROTATION + REST


def header(version=3, n=1, degree=1, bits=8, flags=0, last=0, magic=b"NGSP"):
    return magic + struct.pack("<IIBBBB", version, n, degree, bits, flags, last)


def unsized(stream):
    return zstandard.ZstdCompressor(write_content_size=False).compress(stream)


def version4(streams, n=1, degree=1, flags=0, extension=b"", table=None, sized=True):
    packed = [zstandard.ZstdCompressor().compress(s) if sized else unsized(s) for s in streams]
    start = 32 + len(extension)
    table = table or [(len(p), len(s)) for p, s in zip(packed, streams, strict=True)]
    head = header(4, n, degree, flags=flags, last=len(streams)) + struct.pack("<I", start) + bytes(12)
    return head + extension + b"".join(struct.pack("<QQ", *row) for row in table) + b"".join(packed)


def expect(gaussians):
    """Check the Gaussian above, in the axes of a PLY: y and z with the opposite sign."""
    np.testing.assert_allclose(gaussians.means, [[1.5, 2, -0.25]])
    np.testing.assert_allclose(gaussians.log_scales, [[-5, 0, 5.9375]])
    np.testing.assert_allclose(gaussians.opacities, [0.2], rtol=1e-6)
    np.testing.assert_allclose(gaussians.sh[0, 0], np.array([0.5, -0.5, -127.5]) / 38.25, rtol=1e-6)
    # Basis functions y, z, x; channels inside.
    rest = np.array([[8, 7, 6], [5, 4, 3], [-2, -1, 0]]) / 128
    np.testing.assert_allclose(gaussians.sh[0, 1:], rest)
    q = gaussians.quats[0] * np.sign(gaussians.quats[0, 1])
    np.testing.assert_allclose(q, [-HALF, HALF, 0, 0], atol=1e-6)


def test_version_3_by_hand(tmp_path):
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header(flags=1) + BODY))
    gaussians, mode, offset = load_spz(path)
    expect(gaussians)
    assert mode == "antialiased" and not offset.any()


def test_version_2_by_hand(tmp_path):
    path = tmp_path / "a.spz"
    rotation = bytes([204, 128, 51])  # xyz as 127.5 q + 127.5, w >= 0
    path.write_bytes(gzip.compress(header(2) + POSITION + OPACITY + COLORS + SCALES + rotation + REST))
    gaussians, mode, _ = load_spz(path)
    np.testing.assert_allclose(gaussians.quats, [[0.52914, 0.6, -0.00392, 0.6]], atol=1e-5)
    np.testing.assert_allclose(gaussians.means, [[1.5, 2, -0.25]])
    assert mode == "classic"
    longer = bytes([255, 255, 255])  # than a unit vector: w is 0
    path.write_bytes(gzip.compress(header(2) + POSITION + OPACITY + COLORS + SCALES + longer + REST))
    np.testing.assert_allclose(np.abs(load_spz(path)[0].quats), [[0, 3**-0.5, 3**-0.5, 3**-0.5]], atol=1e-6)


def test_version_4_by_hand(tmp_path):
    path = tmp_path / "a.spz"
    streams = [POSITION, OPACITY, COLORS, SCALES, ROTATION, REST]
    path.write_bytes(version4(streams))
    expect(load_spz(path)[0])
    path.write_bytes(version4(streams[:5], degree=0))
    assert load_spz(path)[0].sh.shape == (1, 1, 3)
    path.write_bytes(version4(streams, flags=2, extension=bytes(12)))
    with pytest.warns(UserWarning, match="vendor-specific"):
        expect(load_spz(path)[0])
    path.write_bytes(version4([*streams[:5], bytes(range(72))], degree=4))
    with pytest.warns(UserWarning, match="degree 4 are cut to 3"):
        assert load_spz(path)[0].sh.shape == (1, 16, 3)


def test_what_is_written(tmp_path):
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header() + BODY))
    gaussians = load_spz(path)[0]
    gaussians.sh[0, 1:] *= 4  # to multiples of the step
    save_spz(path, gaussians)
    assert path.read_bytes()[4:8] == bytes(4), "no time of writing"
    written = gzip.decompress(path.read_bytes())
    bits = fractional_bits(path, gaussians)
    assert written[:16] == header(bits=bits)
    fixed = [int.from_bytes(written[16 + 3 * i : 19 + 3 * i], "little", signed=True) for i in range(3)]
    assert fixed == [v << bits >> 8 if bits >= 8 else v >> (8 - bits) for v in (384, -512, 64)]
    assert written[25:32] == OPACITY + COLORS + SCALES
    assert written[36:] == bytes(128 + 4 * (b - 128) for b in REST)


def test_shared_bands_are_precise_and_small(tmp_path):
    """Gaussians that share their bands come one after the other; the bands have steps of 1/128 instead of 1/32."""
    rng = np.random.default_rng(0)
    scene = Gaussians(
        rng.normal(size=(3000, 3)),
        rng.normal(-3, 0.5, (3000, 3)),
        rng.normal(size=(3000, 4)),
        rng.normal(size=3000),
        rng.normal(scale=0.2, size=(3000, 16, 3)).clip(-0.9, 0.9),
    ).astype(np.float32)
    sizes = []
    for kinds, error in ((3000, 1 / 64), (40, 1 / 256)):
        scene.sh[:, 1:] = scene.sh[rng.integers(kinds, size=3000) if kinds < 3000 else np.arange(3000), 1:]
        save_spz(tmp_path / "a.spz", scene)
        sizes.append((tmp_path / "a.spz").stat().st_size)
        found = load_spz(tmp_path / "a.spz")[0]
        # The order of the file is another: each Gaussian is found by its place.
        at = np.linalg.norm(found.means[:, None] - scene.means, axis=2).argmin(axis=1)
        assert sorted(at) == list(range(3000))
        worst = np.abs(found.sh[:, 1:] - scene.sh[at, 1:]).max()
        assert 0.9 * error < worst <= error * (1 + 1e-5)
        bands = found.sh[:, 1:].reshape(3000, -1)
        assert (np.diff(bands, axis=0) != 0).any(axis=1).sum() == kinds - 1, "equal bands are not in one place"
    assert sizes[1] < 0.5 * sizes[0]


def test_turning_the_axes_turns_the_picture(tmp_path):
    """The colour along a direction in the axes of the file equals that of the scene along the turned direction."""
    from clsplat.reference.sh import sh_basis

    rng = np.random.default_rng(0)
    path = tmp_path / "a.spz"
    rest = rng.integers(64, 192, (1, 15, 3)).astype(np.uint8)
    path.write_bytes(gzip.compress(header(degree=3) + BODY[:-9] + rest.tobytes()))
    sh = load_spz(path)[0].sh[0, 1:]
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    in_file = sh_basis(directions, 3)[:, 1:] @ ((rest[0] - 128.0) / 128)
    np.testing.assert_allclose(sh_basis(directions * [1, -1, -1], 3)[:, 1:] @ sh, in_file, atol=1e-6)


def small(scale, far):
    return Gaussians(
        np.array([[far, 0, 0], [0, 0, 0]]),
        np.full((2, 3), np.log(scale)),
        np.eye(4)[:2],
        np.zeros(2),
        np.zeros((2, 1, 3)),
    )


@pytest.mark.parametrize(
    ("scale", "far", "bits", "coarse"),
    [
        (1.0, 1.0, 3, False),
        (1e-3, 1.0, 13, False),
        (1e-9, 1.0, 22, False),
        (1e-3, 4095.0, 11, True),
        (1e-3, -4096.0, 10, True),
        (1e-3, 4095.9998, 10, True),
        (1e3, 1.0, 0, False),
    ],
)
def test_positions_keep_the_bits_that_the_scene_calls_for(tmp_path, scale, far, bits, coarse):
    gaussians = small(scale, far)
    message = "a.spz: positions have steps of .* coordinate is 4.1e"
    with pytest.warns(UserWarning, match=message) if coarse else nullcontext():
        assert fractional_bits("a.spz", gaussians) == bits
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the scales
        save_spz(tmp_path / "a.spz", gaussians)
    found = np.sort(load_spz(tmp_path / "a.spz")[0].means[:, 0])
    np.testing.assert_allclose(found, sorted([far, 0.0]), atol=2.0**-bits / 2)


def test_positions_beyond_24_bits(tmp_path):
    with pytest.raises(InputError, match="within ±8388608 units, found 1e"):
        save_spz(tmp_path / "a.spz", small(1, 1e7))
    assert not list(tmp_path.iterdir())


def broken_files():
    streams = [POSITION, OPACITY, COLORS, SCALES, ROTATION, REST]
    sizes = [(5, len(s)) for s in streams]
    whole = gzip.compress(header() + BODY)
    shorter = [(len(unsized(s)), len(s)) for s in streams[:5]] + [(len(unsized(REST[:5])), 9)]
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 20))
    lying = version4(streams, table=[(len(bomb), 9), *sizes[1:]])
    wrong_sum = bytearray(whole)
    wrong_sum[-8] ^= 1
    return {
        "magic": (gzip.compress(header(magic=b"NGSQ") + BODY), "begins with NGSP, found b'NGSQ'"),
        "version 1": (gzip.compress(header(1) + BODY), "version 2, 3 or 4, found version 1"),
        "version 5": (header(5) + bytes(99), "version 2, 3 or 4, found version 5"),
        "version 4 in gzip": (gzip.compress(header(4) + BODY), "found version 4"),
        "none": (gzip.compress(header(n=0)), "at least one Gaussian"),
        "degree": (gzip.compress(header(degree=5) + BODY), "SH degree 0 to 4"),
        "bits": (gzip.compress(header(bits=24) + BODY), "0 to 23 fractional bits, found 1 and 24"),
        "huge": (gzip.compress(header(n=2**32 - 1) + BODY), "exhaust memory"),
        "huge 4": (version4(streams, n=2**32 - 1), "exhaust memory"),
        "more than there is": (gzip.compress(header(n=2) + BODY), "truncated"),
        "more than declared": (gzip.compress(header() + BODY + b"x"), "more bytes than they take"),
        "no sum": (whole[:-4], "truncated"),
        "wrong sum": (bytes(wrong_sum), "CRC"),
        "deflate": (whole[:12] + b"\xff\xff" + whole[14:], "cannot read"),
        "table": (version4(streams, table=[*sizes[:5], (5, 10)]), "expected streams of"),
        "five streams": (version4(streams[:5]), "expected streams of"),
        "table beyond the end": (header(4, last=6) + struct.pack("<I", 10**9) + bytes(12), "table of streams"),
        "frame declares more": (lying[:128] + bomb, "declares another size"),
        "a short stream": (version4([*streams[:5], REST[:5]], table=shorter, sized=False), "5 bytes instead of 9"),
        "no frame": (version4(streams)[:128] + bytes(99), "truncated"),
    }


@pytest.mark.parametrize("case", broken_files())
def test_a_broken_file_is_one_sentence(tmp_path, case):
    content, message = broken_files()[case]
    path = tmp_path / "a.spz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        load_spz(path)
    text = str(caught.value)
    assert text.startswith((f"{path}: ", f"cannot read {path}: ")) and len(text.splitlines()) == 1


def test_a_bomb_is_refused_before_it_unfolds(tmp_path, monkeypatch):
    path = tmp_path / "a.spz"
    n = 1 << 16
    path.write_bytes(gzip.compress(header(n=n, degree=0) + bytes(20 * n)))
    assert path.stat().st_size * quantisation.EXPANSION_MAX < 20 * n
    assert len(load_spz(path)[0]) == n  # too small to exhaust memory
    monkeypatch.setattr(quantisation, "EXPANSION_FREE", 1 << 10)
    with pytest.raises(InputError, match="exhaust memory"):
        load_spz(path)


def axes_record(axes):
    return struct.pack("<III", 0xADBE0003, 4, axes)


OTHER = struct.pack("<II", 0x12340001, 3) + b"abc"


@pytest.mark.parametrize(
    ("axes", "signs"), [(0, (1, -1, -1)), (1, (-1, 1, -1)), (4, (1, -1, -1)), (6, (1, 1, 1)), (7, (-1, -1, 1))]
)
def test_recorded_axes_are_obeyed(tmp_path, axes, signs):
    """In version 4 before the table, in version 3 after the planes; after another vendor's record, too."""
    path = tmp_path / "a.spz"
    streams = [POSITION, OPACITY, COLORS, SCALES, ROTATION, REST]
    for content in (
        version4(streams, flags=2, extension=OTHER + axes_record(axes)),
        gzip.compress(header(flags=2) + BODY + OTHER + axes_record(axes)),
    ):
        path.write_bytes(content)
        np.testing.assert_allclose(load_spz(path)[0].means, [np.array([1.5, -2, 0.25]) * signs])
        np.testing.assert_allclose(load_spz(path, "rdf")[0].means, [[1.5, -2, 0.25]])
        np.testing.assert_allclose(load_spz(path, "rub")[0].means, [[1.5, 2, -0.25]])


@pytest.mark.parametrize("axes", [2, 9, 2**32 - 1])
def test_axes_that_are_not_read(tmp_path, axes):
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header(flags=2) + BODY + axes_record(axes)))
    with pytest.raises(InputError, match=f"found axes {axes} of SPZ_ADOBE_coordinate_system"):
        load_spz(path)


@pytest.mark.parametrize("records", [OTHER, OTHER[:9], b"", axes_record(6)[:-1]])
def test_records_without_axes_are_ignored(tmp_path, records):
    path = tmp_path / "a.spz"
    path.write_bytes(gzip.compress(header(flags=2) + BODY + records))
    with pytest.warns(UserWarning, match="vendor-specific records are ignored"):
        expect(load_spz(path)[0])


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("axes", ["rub", "rdf"])
@pytest.mark.parametrize("degree", [0, 2])
def test_versions_and_axes_hold_the_same(tmp_path, version, axes, degree):
    path = tmp_path / "a.spz"
    gaussians = random_gaussians(200, degree)
    save_spz(path, gaussians, "antialiased", version=version, axes=axes)
    recorded = (version, axes) == (4, "rdf")
    found, mode, _ = load_spz(path) if recorded else load_spz(path, axes)
    assert mode == "antialiased"
    assert_within(matched(found, gaussians), gaussians, BOUNDS[".spz"](gaussians))
    assert path.read_bytes()[:4] == (b"NGSP" if version == 4 else b"\x1f\x8b\x08\x00")
    text = "axes recorded as right, down, forward" if recorded else "axes not recorded"
    assert text in anatomy_of(path).comments[1]


def room(up):
    """A floor and a table, and above them shapes without a level; `up` is the sign of y upwards."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-1, 1, (900, 3))
    means[:, 1] *= up
    means[:400, 1] = -up
    log_scales = np.full((900, 3), -3.0)
    log_scales[:400, 1] = -6
    quats = rng.normal(size=(900, 4))
    quats[:400] = [1, 0, 0, 0]
    return Gaussians(means, log_scales, quats, np.full(900, 2.0), np.zeros((900, 1, 3))).astype(np.float32)


def test_axes_are_guessed_from_level_surfaces(tmp_path):
    path = tmp_path / "a.spz"
    assert guessed_axes(room(1)) == "rub" and guessed_axes(room(-1)) == "rdf"
    background = room(1)  # one huge Gaussian, level and above the others
    background.means[-1], background.log_scales[-1], background.quats[-1] = (0, 2, 0), (4, -6, 4), (1, 0, 0, 0)
    assert guessed_axes(background) == "rub"
    tilted = room(1)
    tilted.means[:, [0, 1]] = tilted.means[:, [1, 0]]
    assert guessed_axes(tilted) is None and guessed_axes(room(1).take(np.arange(3))) is None
    for axes, text in {
        "rub": "axes not recorded, read as right, up, back as specified; so its level surfaces suggest",
        "rdf": "but its level surfaces suggest right, down, forward: export --spz-axes rdf reads it so",
    }.items():
        save_spz(path, room(-1), axes=axes)
        assert text in anatomy_of(path).comments[1]
