"""Photo files of each kind are read correctly, or refused with their name."""

import subprocess
import sys
import tracemalloc
import zlib

import numpy as np
import pytest
from PIL import ExifTags, Image

from clsplat.dataset.photos import (
    is_plain,
    is_transparent,
    list_photos,
    orientation,
    photo_size,
    read_mask,
    read_photo,
    write_upright_png,
)
from clsplat.errors import InputError

RNG = np.random.default_rng(5)
RGB = RNG.integers(0, 256, (12, 20, 3)).astype(np.uint8)
BLACK = (0.0, 0.0, 0.0)


def read(path, background=BLACK, upright=False):
    pixels = read_photo(path, background, upright)
    assert pixels.dtype == np.uint8 and pixels.flags.c_contiguous
    return pixels


def save_turned(path, tag, pixels=RGB):
    exif = Image.Exif()
    exif[0x0112] = tag
    exif[0x010F] = "maker"
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLength: 24.5}
    exif[ExifTags.IFD.GPSInfo] = {ExifTags.GPS.GPSLatitudeRef: "N"}
    Image.fromarray(pixels).save(path, exif=exif.tobytes())
    return path


@pytest.mark.parametrize("ending", ["png", "bmp", "tif", "webp"])
def test_rgb_is_read_unchanged(tmp_path, ending):
    Image.fromarray(RGB).save(tmp_path / f"a.{ending}", lossless=True)
    np.testing.assert_array_equal(read(tmp_path / f"a.{ending}"), RGB)


def test_grey_and_sixteen_bits_become_rgb(tmp_path):
    Image.fromarray(RGB[..., 0]).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read(tmp_path / "grey.png"), np.repeat(RGB[..., :1], 3, axis=2))
    Image.fromarray(RGB[..., 0].astype(np.uint16) * 257).save(tmp_path / "deep.png")  # 255 -> 65535
    np.testing.assert_array_equal(read(tmp_path / "deep.png"), np.repeat(RGB[..., :1], 3, axis=2))


def test_eight_bits_in_sixteen_are_refused(tmp_path):
    Image.fromarray(RGB[..., 0].astype(np.uint16)).save(tmp_path / "deep.png")
    for reading in (read, read_mask):
        with pytest.raises(InputError, match=r"deep\.png: expected values up to 65535 in 16 bits, found none above"):
            reading(tmp_path / "deep.png")
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(tmp_path / "black.png")
    assert not read(tmp_path / "black.png").any()


def test_sixteen_bit_rgb(tmp_path):
    tifffile = pytest.importorskip("tifffile")  # comes with scikit-image; Pillow cannot write such a file
    tifffile.imwrite(tmp_path / "deep.tif", RGB.astype(np.uint16) * 257, photometric="rgb")
    np.testing.assert_array_equal(read(tmp_path / "deep.tif"), RGB)


def test_palette_and_cmyk(tmp_path):
    image = Image.fromarray(RGB).quantize(256)
    image.save(tmp_path / "palette.png")
    np.testing.assert_array_equal(read(tmp_path / "palette.png"), np.asarray(image.convert("RGB")))
    flat = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    Image.fromarray(flat).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=100)
    # A JPEG of a single colour: only its transforms round
    np.testing.assert_allclose(read(tmp_path / "cmyk.jpg").astype(int), flat, atol=2)


@pytest.mark.parametrize("background", [BLACK, (1.0, 1.0, 1.0), (0.2, 0.4, 0.6)])
def test_transparency_shows_the_background(tmp_path, background):
    alpha = RNG.integers(0, 256, (12, 20)).astype(np.uint8)
    Image.fromarray(np.dstack([RGB, alpha])).save(tmp_path / "a.png")
    weight = alpha[..., None] / 255
    expected = RGB * weight + 255 * np.array(background) * (1 - weight)
    # Rounding costs half a level; float32 may round exact halves the other way.
    np.testing.assert_allclose(read(tmp_path / "a.png", background), expected, atol=0.5 + 1e-4)


@pytest.mark.parametrize("mode", ["LA", "P"])
def test_transparent_grey_and_palette(tmp_path, mode):
    image = Image.new(mode, (4, 4), 0)
    image.save(tmp_path / "a.png", **({"transparency": 0} if mode == "P" else {}))
    assert (read(tmp_path / "a.png", (1.0, 1.0, 1.0)) == 255).all()


WHITE = (1.0, 1.0, 1.0)


def test_a_transparent_colour_of_sixteen_bits(tmp_path):
    """It is compared in 16 bits: the neighbour, which has the same upper 8 bits, is opaque."""
    Image.fromarray(np.array([[0x1234, 0x1235, 0x8000]], np.uint16)).save(tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    kind, value = b"tRNS", b"\x12\x34"
    chunk = len(value).to_bytes(4, "big") + kind + value + zlib.crc32(kind + value).to_bytes(4, "big")
    at = data.index(b"IDAT") - 4
    (tmp_path / "a.png").write_bytes(data[:at] + chunk + data[at:])
    assert is_transparent(tmp_path / "a.png")
    assert read_photo(tmp_path / "a.png", WHITE, True)[0].tolist() == [[255] * 3, [0x12] * 3, [0x80] * 3]


def test_a_transparent_colour_that_pillow_cannot_compare_is_refused(tmp_path):
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "a.png", transparency=(0x1234, 0, 0))
    with pytest.raises(
        InputError, match=r"a\.png: expected 8 bits per channel beside a transparent colour, found 16"
    ):
        read_photo(tmp_path / "a.png", WHITE, True)


@pytest.mark.parametrize("ending", ["png", "tif"])  # Pillow itself turns a TIFF
@pytest.mark.parametrize("tag", range(1, 9))
def test_orientation_is_applied_when_asked(tmp_path, tag, ending):
    path = save_turned(tmp_path / f"a.{ending}", tag)
    # EXIF 2.32, "Orientation": where row 0 and column 0 of the stored pixels are when the photo is upright
    upright = {
        1: RGB,
        2: RGB[:, ::-1],
        3: RGB[::-1, ::-1],
        4: RGB[::-1],
        5: RGB.swapaxes(0, 1),
        6: RGB.swapaxes(0, 1)[:, ::-1],
        7: RGB.swapaxes(0, 1)[::-1, ::-1],
        8: RGB.swapaxes(0, 1)[::-1],
    }[tag]
    assert orientation(path) == tag
    assert photo_size(path) == (20, 12)
    np.testing.assert_array_equal(read(path), RGB)
    np.testing.assert_array_equal(read(path, upright=True), upright)
    write_upright_png(path, tmp_path / "sub" / "b.jpg")
    np.testing.assert_array_equal(read(tmp_path / "sub" / "b.jpg"), upright)
    assert orientation(tmp_path / "sub" / "b.jpg") == 1
    with Image.open(tmp_path / "sub" / "b.jpg") as copy:
        exif = copy.getexif()
        assert exif[0x010F] == "maker" and exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] == 24.5
        assert exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] == "N"


def test_plain_photos_are_upright_8_bit_rgb_or_grey(tmp_path):
    def saved(name, image, **options):
        image.save(tmp_path / name, **options)
        return is_plain(tmp_path / name)

    rgb = Image.fromarray(RGB)
    assert saved("a.png", rgb) and saved("b.jpg", rgb) and saved("c.png", rgb.convert("L"))
    for name, image in [
        ("d.png", rgb.convert("P")),
        ("e.png", rgb.convert("RGBA")),
        ("f.jpg", rgb.convert("CMYK")),
        ("g.webp", rgb),
        ("h.png", Image.fromarray(RGB[..., 0].astype(np.uint16))),
    ]:
        assert not saved(name, image), name
    assert not saved("i.png", rgb, transparency=(1, 2, 3))
    assert not is_plain(save_turned(tmp_path / "j.jpg", 3))


@pytest.mark.parametrize("kind", ["cut jpg", "cut png", "flipped png", "text", "empty", "float", "missing"])
def test_bad_files_are_refused_by_name(tmp_path, kind):
    path = tmp_path / "bad.png"
    Image.fromarray(RNG.integers(0, 256, (64, 64, 3)).astype(np.uint8)).save(
        path, format="JPEG" if kind == "cut jpg" else "PNG"
    )
    data = bytearray(path.read_bytes())
    if kind.startswith("cut"):
        path.write_bytes(data[: len(data) // 2])
    elif kind == "flipped png":
        data[len(data) // 2] ^= 0xFF
        path.write_bytes(data)
    elif kind == "float":
        Image.fromarray(np.ones((4, 4), np.float32)).save(path, format="TIFF")
    elif kind == "missing":
        path.unlink()
    else:
        path.write_bytes(b"not an image" if kind == "text" else b"")
    with pytest.raises(InputError, match=r"bad\.png"):
        read_photo(path, BLACK, True)


def test_masks_are_white_where_pixels_count(tmp_path):
    pattern = RNG.integers(0, 2, (12, 20)).astype(bool)
    for name, image in [
        ("grey.png", Image.fromarray(pattern.astype(np.uint8) * 255)),
        ("bits.png", Image.fromarray(pattern)),
        ("rgb.png", Image.fromarray(pattern.astype(np.uint8) * 255).convert("RGB")),
    ]:
        image.save(tmp_path / name)
        np.testing.assert_array_equal(read_mask(tmp_path / name), pattern)
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "black.png")
    assert not read_mask(tmp_path / "black.png").any()


def test_a_mask_of_zeros_and_ones_is_refused(tmp_path):
    Image.fromarray(np.eye(4, dtype=np.uint8)).save(tmp_path / "ones.png")
    with pytest.raises(InputError, match=r"ones\.png.*white"):
        read_mask(tmp_path / "ones.png")


def test_photos_are_listed_by_name(tmp_path):
    for name in ("b.JPG", "a.png", "c.txt", ".hidden.jpg", "sub/d.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert list_photos(tmp_path) == ["a.png", "b.JPG"]
    (tmp_path / "images" / "right").mkdir(parents=True)
    (tmp_path / "images" / "right" / "2.jpg").touch()
    (tmp_path / "images" / "1.jpg").touch()
    assert list_photos(tmp_path) == ["1.jpg", "right/2.jpg"]


def test_pillow_still_writes_once_pycolmap_is_loaded(tmp_path):
    # Loaded in the other order Pillow crashes the process; see clsplat.dataset.lenses.
    code = (
        "import sys; from clsplat.dataset.lenses import Intrinsics, undistorted\n"
        "undistorted(Intrinsics('RADIAL', (50., 32., 24., 0.1, 0.), 64, 48))\n"
        "from PIL import Image; Image.effect_noise((64, 64), 50).save(sys.argv[1])\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.png")], capture_output=True, timeout=60, check=False
    )
    assert result.returncode == 0, result.stderr


def test_chunks_take_no_more_memory_than_the_file_has(tmp_path):
    """Found by fuzzing: decoders allocated the 256 MiB that a flipped bit declared."""
    path = tmp_path / "photo.png"
    Image.fromarray(RGB).save(path)
    content = bytearray(path.read_bytes())
    content[content.index(b"IDAT") - 4] = 0x10
    path.write_bytes(content)
    tracemalloc.start()
    read_photo(path, BLACK, upright=True)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1 << 24
