"""Pictures, the page and the chart: what they show, read back from the files."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from clsplat.errors import InputError
from clsplat.show.evaluation_page import (
    DIFFERENCE_MAX,
    save_difference,
    save_png,
    side_by_side,
    training_curve,
    write_page,
)


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


def test_side_by_side_holds_both_pictures(tmp_path):
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


def test_page_escapes_what_it_is_given_and_puts_equal_images_last(tmp_path):
    views = [
        {"name": f"<{k}>", "psnr": psnr, "psnr_fitted": psnr, "ssim": 0.5, "flip": None, "width": 4, "height": 3}
        | {kind: f'{kind}/"{k}" #<.png' for kind in ("truth", "render", "difference")}
        for k, psnr in enumerate([None, 31.25, 20.0, -1.5])
    ]
    result = {
        "mean": {"psnr": None, "psnr_fitted": None, "ssim": 0.5, "flip": None},
        "num_gaussians": 1234567,
        "sh_degree": 2,
    }
    result |= {"mode": "classic", "resolution": "4x3", "device": "<PoCL> & CPU", "views": views}
    write_page(tmp_path / "index.html", result)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    positions = [text.index(f"<h3>&lt;{k}&gt;</h3>") for k in (3, 2, 1, 0)]
    assert positions == sorted(positions)
    assert "&lt;PoCL&gt; &amp; CPU" in text and "1,234,567 Gaussians" in text
    assert 'href="truth/%220%22%20%23%3C.png"' in text
    assert "<0>" not in text and "FLIP" not in text
    assert re.findall(r"height:([-\d.]+)%", text) == ["100.0", "100.0", "64.0", "0.0"]


def write_log(path, records):
    path.write_text("".join(json.dumps(record) + "\n" for record in records))


def records(with_psnr):
    found = []
    for i in range(10, 1001, 10):
        record = {"iteration": i, "num_gaussians": 100 + i, "seconds": 0.1 * i, "loss": 0.2 * 0.999**i}
        if with_psnr and i % 250 == 0:
            record |= {"psnr": 20 + i / 100, "ssim": 0.8}
        found.append(record)
    return found


def has_color(picture, color):
    wanted = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
    return (np.abs(picture.astype(int) - wanted).max(axis=2) < 8).sum() > 100


@pytest.mark.parametrize("with_psnr", [False, True])
def test_curve_shows_what_is_logged(tmp_path, with_psnr):
    log, chart = tmp_path / "log.jsonl", tmp_path / "chart.png"
    write_log(log, records(with_psnr))
    training_curve(log, chart)
    picture = read(chart)
    assert has_color(picture, "#0072b2") and has_color(picture, "#009e73")
    assert has_color(picture, "#d55e00") == with_psnr
    before = chart.read_bytes()
    training_curve(log, chart)
    assert chart.read_bytes() == before


def test_curve_of_a_run_that_is_still_writing(tmp_path):
    log, chart = tmp_path / "log.jsonl", tmp_path / "chart.png"
    write_log(log, records(True)[:1])
    training_curve(log, chart)
    before = chart.read_bytes()
    with log.open("a") as file:
        file.write('{"iteration": 20, "num_')
    training_curve(log, chart)
    assert chart.read_bytes() == before
    # An evaluation before the first loss has a line of its own.
    write_log(log, [{"iteration": 1, "num_gaussians": 9, "seconds": 1.0, "psnr": 12.0, "ssim": 0.1}])
    training_curve(log, chart)
    assert has_color(read(chart), "#d55e00")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "found none"),
        (b'{"iteration": 1}\n', "line 1"),
        (b'{"iteration": 1, "num_gaussians": 2, "seconds": 3}\nnot json\n', "line 2.*'not json'"),
        (b"[1]\n", "line 1"),
        (b"\xff\n", "readable"),
    ],
)
def test_a_log_that_is_none(tmp_path, content, message):
    (tmp_path / "log.jsonl").write_bytes(content)
    with pytest.raises(InputError, match=message):
        training_curve(tmp_path / "log.jsonl", tmp_path / "chart.png")
    assert not (tmp_path / "chart.png").exists()
    with pytest.raises(InputError, match=r"missing\.jsonl"):
        training_curve(tmp_path / "missing.jsonl", tmp_path / "chart.png")
