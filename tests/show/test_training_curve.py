"""The chart of a training log, read back from its file."""

import json

import numpy as np
import pytest
from matplotlib.figure import Figure
from test_comparisons import read

from clsplat.errors import InputError
from clsplat.show.training_curve import training_curve


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


def test_the_smooth_loss_is_the_mean_around_each_iteration(tmp_path, monkeypatch):
    """Of a fiftieth of the lines: 3 of 150. On a straight line, a mean around a point is the point."""
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    lines = [{"iteration": 10 * k, "num_gaussians": 9, "seconds": 1.0, "loss": 1 - k / 200} for k in range(1, 151)]
    write_log(tmp_path / "log.jsonl", lines)
    training_curve(tmp_path / "log.jsonl", tmp_path / "chart.png")
    raw, smooth = (line.get_xydata() for line in drawn[0].axes[0].lines)
    assert len(raw) == 150
    np.testing.assert_allclose(smooth, raw[1:-1], rtol=1e-12)


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
        (b"\xff\n", "cannot read .*log.jsonl: .*utf-8"),
    ],
)
def test_an_invalid_log_is_refused(tmp_path, content, message):
    (tmp_path / "log.jsonl").write_bytes(content)
    with pytest.raises(InputError, match=message):
        training_curve(tmp_path / "log.jsonl", tmp_path / "chart.png")
    assert not (tmp_path / "chart.png").exists()
    with pytest.raises(InputError, match=r"cannot read .*missing\.jsonl: No such file"):
        training_curve(tmp_path / "missing.jsonl", tmp_path / "chart.png")
