"""Photos from videos: the sharpest frame of each interval, upright, extracted once; and HEIC photos."""

import json
import struct
import sys

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from clsplat.cli import main
from clsplat.config import SfmConfig
from clsplat.dataset import photos
from clsplat.dataset.photos import (
    FRAMES,
    list_photos,
    orientation,
    photo_size,
    read_photo,
    sharpness,
    write_upright_png,
)
from clsplat.dataset.sfm.reconstruction import _resolved
from clsplat.dataset.video import extract_frames
from clsplat.errors import InputError

SHARP = (3, 8)
"""Indices of the sharp frames, one of each six."""

NUMBERS = np.random.default_rng(0)
TEXTURE = NUMBERS.uniform(0, 255, (64, 96))


def frames():
    """Twelve grey frames, darker to brighter, all but two of them blurred, and the later half with less contrast."""
    for k in range(12):
        pattern = TEXTURE if k in SHARP else gaussian_filter(TEXTURE, 2)
        yield np.repeat(
            np.clip(pattern * (0.4 if k < 6 else 0.3) + 10 * k, 0, 255).astype(np.uint8)[..., None], 3, axis=2
        )


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """A video of twelve frames at 6 per second."""
    av = pytest.importorskip("av")
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=6)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 96, 64, "yuv420p", 4_000_000
        for pixels in frames():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    return path


def test_the_sharpest_frame_of_each_interval_is_taken(video, tmp_path):
    assert extract_frames(video, tmp_path / "out", 1.0) == 2
    assert list_photos(tmp_path / "out") == ["frame_00001.jpg", "frame_00002.jpg"]
    wanted = list(frames())
    for name, k in zip(list_photos(tmp_path / "out"), SHARP, strict=True):
        pixels = read_photo(tmp_path / "out" / name, (0, 0, 0), False).astype(float)
        errors = [np.abs(pixels - frame).mean() for frame in wanted]
        assert np.argmin(errors) == k and errors[k] < 10, errors
    assert (tmp_path / "out").stat().st_mode & 0o055 == 0o055, "others may read the frames"
    assert extract_frames(video, tmp_path / "three", 1.5) == 3
    assert extract_frames(video, tmp_path / "all", 1000) == 12


def test_a_second_run_leaves_what_is_there(video, tmp_path):
    out = tmp_path / "out"
    extract_frames(video, out, 1.0)
    (out / "frame_00001.jpg").write_bytes(b"mine")
    (out / "sparse").mkdir()
    assert extract_frames(video, out, 1.0) == 2 and (out / "frame_00001.jpg").read_bytes() == b"mine"
    with pytest.raises(InputError, match="expected a new or empty folder"):
        extract_frames(video, out, 2.0)
    (out / FRAMES).unlink()
    with pytest.raises(InputError, match="expected a new or empty folder"):
        extract_frames(video, out, 1.0)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_phones_turn_their_videos_by_a_matrix(video, tmp_path):
    """The matrix of the MP4's track header, ISO/IEC 14496-12, for a display turned by 90 degrees clockwise."""
    data = bytearray(video.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    identity = (1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    assert struct.unpack_from(">9i", data, at) == identity
    struct.pack_into(">9i", data, at, 0, 1 << 16, 0, -(1 << 16), 0, 0, 64 << 16, 0, 1 << 30)
    (tmp_path / "turned.mp4").write_bytes(data)
    extract_frames(tmp_path / "turned.mp4", tmp_path / "out", 1.0)
    pixels = read_photo(tmp_path / "out" / "frame_00001.jpg", (0, 0, 0), False).astype(float)
    wanted = np.rot90(list(frames())[SHARP[0]], -1)
    assert pixels.shape == wanted.shape and np.abs(pixels - wanted).mean() < 10


def test_frames_are_matched_with_their_neighbours(video, tmp_path):
    assert _resolved(SfmConfig(), tmp_path, 3).matching == "exhaustive"
    extract_frames(video, tmp_path / "out", 1.0)
    assert _resolved(SfmConfig(), tmp_path / "out", 3).matching == "sequential"
    assert _resolved(SfmConfig(matching="exhaustive"), tmp_path / "out", 3).matching == "exhaustive"


def test_the_command(video, tmp_path, capsys):
    main(["frames", str(video), "-o", str(tmp_path / "out"), "--fps", "1"])
    assert "2 frames of clip.mp4; next: clsplat train" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / FRAMES).read_text())["fps"] == 1
    # train extracts frames itself; two seconds of this video are too short for structure from motion.
    with pytest.raises(SystemExit):
        main(["train", str(video), "-o", str(tmp_path / "scene"), "--sfm.min-registered", "9"])
    error = capsys.readouterr().err
    assert "4 frames of clip.mp4" in error and "expected at least 9 photos, found 4" in error
    assert len(list_photos(tmp_path / "scene" / "frames")) == 4


def test_what_is_no_video_is_refused(tmp_path, monkeypatch, video):
    (tmp_path / "a.mp4").write_bytes(b"no video" * 100)
    with pytest.raises(InputError, match=r"cannot read .*a\.mp4 as a video"):
        extract_frames(tmp_path / "a.mp4", tmp_path / "out")
    with pytest.raises(InputError, match="found nothing"):
        extract_frames(tmp_path / "none.mp4", tmp_path / "out")
    for rate in (0, -1, float("nan")):
        with pytest.raises(InputError, match="fps: expected a number above 0"):
            extract_frames(video, tmp_path / "out", rate)
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"pip install 'clsplat\[video\]'"):
        extract_frames(video, tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_blur_lowers_the_sharpness():
    image = TEXTURE.astype(np.uint8)
    scores = [sharpness(gaussian_filter(image, s)) for s in (0, 1, 2, 4)]
    assert scores == sorted(scores, reverse=True) and scores[-1] < scores[0] / 100
    assert sharpness(np.zeros((2, 2), np.uint8)) == 0


def test_heic_photos_are_read_and_come_upright(tmp_path):
    pillow_heif = pytest.importorskip("pillow_heif")
    pixels = np.kron(NUMBERS.integers(0, 256, (4, 6, 3), np.uint8), np.ones((16, 16, 1), np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    pillow_heif.register_heif_opener()
    image = Image.fromarray(pixels)
    image.save(tmp_path / "a.HEIC", format="HEIF", quality=-1, chroma=444)
    image.save(tmp_path / "b.heif", format="HEIF", quality=-1, chroma=444, exif=exif.tobytes())
    assert list_photos(tmp_path) == ["a.HEIC", "b.heif"]
    np.testing.assert_allclose(read_photo(tmp_path / "a.HEIC", (0, 0, 0), True), pixels, atol=3)
    # HEIF has its own property for the orientation, which readers apply; it is written here from the tag.
    upright = np.rot90(pixels, -1)
    assert photo_size(tmp_path / "b.heif") == upright.shape[1::-1] and orientation(tmp_path / "b.heif") == 1
    np.testing.assert_allclose(read_photo(tmp_path / "b.heif", (0, 0, 0), False), upright, atol=3)
    write_upright_png(tmp_path / "b.heif", tmp_path / "copy" / "b.heif")
    np.testing.assert_allclose(read_photo(tmp_path / "copy" / "b.heif", (0, 0, 0), True), upright, atol=3)


def test_heic_without_its_package_says_how_to_get_it(tmp_path, monkeypatch):
    (tmp_path / "a.heic").touch()
    monkeypatch.setattr(photos, "heif_is_read", lambda: False)
    with pytest.raises(
        InputError,
        match=r"cannot read .*a\.heic: .* pillow-heif is not installed; pip install 'clsplat\[heic\]'",
    ):
        read_photo(tmp_path / "a.heic", (0, 0, 0), True)
