"""SOG: images and meta.json made by hand, versions 1 and 2, packed and unpacked, and false declarations."""

import io
import json
import zipfile

import numpy as np
import pytest
from bounds import random_gaussians
from PIL import Image

from clsplat.errors import InputError
from clsplat.formats import load_gaussians, quantisation, save_gaussians
from clsplat.formats.sog import load_sog, save_sog
from clsplat.formats.validity import LOGIT_MAX

N = 2


def picture(rows, width=4, height=4):
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[: len(rows)] = np.reshape(rows, (-1, 4))
    file = io.BytesIO()
    Image.fromarray(pixels.reshape(height, width, 4)).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


# x: 16-bit fractions 65535 and 0 of -1..2; y: 258 of 0..65535 thousandths; z: a range of zero width.
PICTURES = {
    "means_l.webp": picture([[255, 2, 7, 255], [0, 0, 7, 255]]),
    "means_u.webp": picture([[255, 1, 0, 255], [0, 0, 0, 255]]),
    # wxyz without x, from (0.5, 0.5, -0.5, 0.5): 0.5 + q/sqrt(2) of 255; then without w, the identity.
    "quats.webp": picture([[218, 37, 218, 253], [128, 127, 128, 252]]),
    "scales.webp": picture([[0, 128, 255, 255], [1, 2, 3, 255]]),
    "sh0.webp": picture([[0, 255, 51, 51], [1, 2, 3, 0]]),
    # Labels 65 and 1.
    "labels.webp": picture([[65, 0, 0, 255], [1, 0, 0, 255]]),
    "centroids.webp": picture([[i % 256, i // 256, 255, 255] for i in range(2 * 64 * 3)], 64 * 3, 2),
}
BOOK = (np.arange(256) / 8 - 20).tolist()


def meta2(**changes):
    meta = {
        "version": 2,
        "count": N,
        "means": {"mins": [-1, 0, 0.5], "maxs": [2, 65.535, 0.5], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": BOOK, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": BOOK, "files": ["sh0.webp"]},
        "shN": {"count": 128, "bands": 1, "codebook": BOOK, "files": ["centroids.webp", "labels.webp"]},
    }
    return {k: v for k, v in (meta | changes).items() if v is not None}


def meta1():
    ranges = {"mins": [-1, -2, -3], "maxs": [1, 2, 3]}
    return {
        "means": {"shape": [N, 3]} | {k: meta2()["means"][k] for k in ("mins", "maxs", "files")},
        "scales": ranges | {"files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"mins": [-1, -2, -3, -5], "maxs": [1, 2, 3, 5], "files": ["sh0.webp"]},
        "shN": {"mins": -2.0, "maxs": 3.1, "files": ["centroids.webp", "labels.webp"]},
    }


def bundle(path, meta, pictures=PICTURES, folder=""):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in pictures.items():
            archive.writestr(folder + name, data)
        archive.writestr(f"{folder}meta.json", meta if isinstance(meta, str) else json.dumps(meta))


def expect_common(gaussians):
    symexp = [[np.e**2 - 1, np.e**0.258 - 1, np.e**0.5 - 1], [-(np.e - 1), 0, np.e**0.5 - 1]]
    np.testing.assert_allclose(gaussians.means, symexp, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(gaussians.quats, [[0.5, 0.5, -0.5, 0.5], [1, 0, 0, 0]], atol=6e-3)


@pytest.mark.parametrize("folder", ["", "scene/"])
def test_version_2_by_hand(tmp_path, folder):
    path = tmp_path / "a.sog"
    bundle(path, meta2(antialias=True, extras=[{"offset": 1}]), folder=folder)
    found, mode, offset = load_sog(path)
    expect_common(found)
    book = np.array(BOOK)
    np.testing.assert_allclose(found.log_scales, book[[[0, 128, 255], [1, 2, 3]]])
    np.testing.assert_allclose(found.sh[:, 0], book[[[0, 255, 51], [1, 2, 3]]])
    np.testing.assert_allclose(found.opacities, [0.2, 0], atol=1e-6)
    # Entry 65 is the second of the second row, 64 * 3 pixels further; red, green and blue hold the channels.
    np.testing.assert_allclose(found.sh[0, 1:], book[[[195, 0, 255], [196, 0, 255], [197, 0, 255]]])
    np.testing.assert_allclose(found.sh[1, 1:], book[[[3, 0, 255], [4, 0, 255], [5, 0, 255]]])
    assert mode == "antialiased" and not offset.any()


def test_version_1_unpacked_by_hand(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, data in PICTURES.items():
        (folder / name).write_bytes(data)
    (folder / "meta.json").write_text(json.dumps(meta1()))
    for path in (folder, folder / "meta.json"):
        found, mode, _ = load_gaussians(path)
        expect_common(found)
        np.testing.assert_allclose(found.log_scales[0], [-1, -2 + 4 * 128 / 255, 3], rtol=1e-6)
        np.testing.assert_allclose(found.sh[0, 0], [-1, 2, -3 + 6 * 51 / 255], rtol=1e-6)
        np.testing.assert_allclose(found.logit_opacities, [-3, -5])
        np.testing.assert_allclose(found.sh[0, 1], [-2 + 0.02 * 195, -2, 3.1], rtol=1e-5)
        assert mode == "classic"
    wide = meta1()
    wide["sh0"] |= {"mins": [-1, -2, -3, -99], "maxs": [1, 2, 3, 99]}
    (folder / "meta.json").write_text(json.dumps(wide))
    found = load_gaussians(folder)[0]
    np.testing.assert_array_equal(found.logit_opacities, np.float32([-LOGIT_MAX, -LOGIT_MAX]))


def test_what_is_written(tmp_path):
    path = tmp_path / "a.sog"
    gaussians = random_gaussians(70, degree=2)
    save_sog(path, gaussians, "antialiased", [1, 2, 3])
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))
        sizes = {i.filename: Image.open(io.BytesIO(archive.read(i))).size for i in archive.infolist()[:-1]}
        assert {i.compress_type for i in archive.infolist()} == {zipfile.ZIP_STORED}
    assert sizes.pop("shN_centroids.webp") == (64 * 8, 2)
    assert set(sizes.values()) == {(12, 8)} and len(sizes) == 6
    assert (meta["version"], meta["count"], meta["antialias"]) == (2, 70, True)
    assert (meta["shN"]["count"], meta["shN"]["bands"]) == (70, 2)
    assert {len(meta[k]["codebook"]) for k in ("scales", "sh0", "shN")} == {256}
    assert meta["means"]["mins"] == pytest.approx(
        (np.sign(gaussians.means) * np.log1p(np.abs(gaussians.means))).min(axis=0).tolist(), rel=1e-6
    )


def test_colours_of_the_transparent_survive(tmp_path):
    """By default, WebP drops colours where alpha is 0, since they are invisible in an image."""
    gaussians = random_gaussians(64, degree=0)
    gaussians.logit_opacities[:] = -30
    save_gaussians(tmp_path / "a.sog", gaussians)
    found = load_gaussians(tmp_path / "a.sog")[0]
    np.testing.assert_allclose(np.sort(found.sh[:, 0, 0]), np.sort(gaussians.sh[:, 0, 0]), atol=1e-5)


def test_a_palette_stands_for_more_than_its_size(tmp_path):
    """20 000 Gaussians of 300 kinds: each gets its kind, although the palette has entries for a third of them."""
    gaussians = random_gaussians(20_000, degree=1)
    kinds = random_gaussians(300, degree=1).sh[:, 1:]
    gaussians.sh[:, 1:] = kinds[np.arange(20_000) % 300]
    save_sog(tmp_path / "a.sog", gaussians)
    found = load_sog(tmp_path / "a.sog")[0]
    rows = quantisation.morton_order(gaussians.means)
    error = np.abs(found.sh[:, 1:] - gaussians.sh[rows, 1:])
    assert error.max() <= 1.8 / 256


def broken_files():
    white = picture([], 4, 4)
    return {
        "no meta": ({"a": b""}, None, "found 0; it is not a SOG"),
        "no json": (PICTURES, "{", "incomplete"),
        "a list": (PICTURES, "[]", "found version None"),
        "version": (PICTURES, meta2(version=3), "found version 3"),
        "none": (PICTURES, meta2(count=0), "at least one Gaussian, found 0"),
        "half": (PICTURES, meta2(count=1.5), "found 1.5"),
        "huge": (PICTURES, meta2(count=10**12), "found 16 pixels of means"),
        "no sh0": (PICTURES, meta2(sh0=None), "incomplete: KeyError"),
        "codebook": (PICTURES, meta2(scales={"codebook": BOOK[:255], "files": ["scales.webp"]}), "256 numbers"),
        "words": (
            PICTURES,
            meta2(scales={"codebook": ["a"] * 256, "files": ["scales.webp"]}),
            "incomplete: ValueError",
        ),
        "nan": (PICTURES, meta2(scales={"codebook": [np.nan] * 256, "files": ["scales.webp"]}), "found log_scales"),
        "range": (PICTURES, meta2(means=meta2()["means"] | {"maxs": [1e9, 1, 1]}), "found means"),
        "beyond floats": (
            PICTURES,
            meta2(means=meta2()["means"] | {"maxs": [10**400, 1, 1]}),
            "incomplete: OverflowErr",
        ),
        "one range": (
            PICTURES,
            meta2(means=meta2()["means"] | {"mins": [0], "maxs": [1]}),
            r"means of shape \(2, 3\)",
        ),
        "picture": (PICTURES | {"quats.webp": b"RIFF"}, meta2(), "quats.webp is not a WebP image"),
        "cut": (PICTURES | {"quats.webp": PICTURES["quats.webp"][:-9]}, meta2(), "cannot read"),
        "no picture": ({k: v for k, v in PICTURES.items() if k != "quats.webp"}, meta2(), "incomplete: KeyError"),
        "tag": (PICTURES | {"quats.webp": white}, meta2(), "tagged 252 to 255, found 0"),
        "label": (PICTURES | {"labels.webp": picture([[128, 0, 0, 0]])}, meta2(), "palette's 128, found 128"),
        "palette": (PICTURES | {"centroids.webp": white}, meta2(), "pixels width, found 4"),
        "outside": (PICTURES, meta2(quats={"files": ["../quats.webp"]}), "images next to meta.json"),
        "offset": (PICTURES, meta2(extras={"clsplat": {"offset": [1]}}), "incomplete: ValueError.*offset"),
    }


@pytest.mark.parametrize("case", broken_files())
def test_a_broken_file_is_one_sentence(tmp_path, case):
    pictures, meta, message = broken_files()[case]
    path = tmp_path / "a.sog"
    if meta is None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a", b"")
    else:
        bundle(path, meta, pictures)
    with pytest.raises(InputError, match=message) as caught:
        load_sog(path)
    text = str(caught.value)
    assert text.startswith((f"{path}: ", f"cannot read {path}")) and len(text.splitlines()) == 1


def test_bombs_are_refused_before_they_unfold(tmp_path, monkeypatch):
    path = tmp_path / "a.sog"
    large = picture([], 1024, 1024)
    bundle(path, meta2(), PICTURES | {"means_l.webp": large})
    assert len(load_sog(path)[0]) == N  # too small to exhaust memory
    monkeypatch.setattr(quantisation, "EXPANSION_FREE", 1 << 16)
    with pytest.raises(InputError, match="exhaust memory"):
        load_sog(path)
    bundle(path, meta2(), PICTURES | {"zeros": bytes(1 << 22)})
    with pytest.raises(InputError, match="exhaust memory"):
        load_sog(path)


@pytest.mark.parametrize(("number", "error"), [(1, MemoryError), (5, ValueError)])
def test_an_encoder_without_memory_says_so(tmp_path, monkeypatch, number, error):
    """Pillow gives the encoder's number alone; 5 is VP8_ENC_ERROR_BAD_DIMENSION."""

    def fail(*_, **__):
        raise ValueError(f"encoding error {number}")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(error, match="cannot be compressed" if number == 1 else "encoding error 5"):
        save_sog(tmp_path / "a.sog", random_gaussians(3, 0))
    assert list(tmp_path.iterdir()) == []
