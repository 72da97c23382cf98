"""`clsplat bench fields`: counts of evaluations, operations and bytes, and what the command prints."""

import json

import numpy as np
import pytest
from ball_photos import ball
from cli_runs import fails, run
from small_fields import SmallIngp, SmallMipNerf360, SmallNerf

from clsplat.bench.field_account import Work, account, bench_fields, fields_text, watched
from clsplat.config import DataConfig
from clsplat.fields import METHODS
from clsplat.fields.space import Space

WHITE = DataConfig(background="white")


@pytest.fixture(scope="module")
def scene():
    return ball(8, 2)


def test_nerf_asks_at_each_sample(device, scene):
    """16 samples of the coarse network and 32 of the fine one, for rays and for pixels; operations by hand."""
    found = account(SmallNerf, scene, WHITE, device, 1, 2)
    weights = (64 * 32 + 2 * 32 * 32) + (96 * 32 + 32 * 32) + (64 * 16 + 16 * 16)
    unread = 64 * 32 + 64 * 32 + 32 * 16  # weights of inputs whose gradients nobody needs
    for name, operations in (("image", 2 * weights), ("step", 6 * weights - 2 * unread)):
        assert found[name]["evaluations"] == 16 + 32
        assert found[name]["operations"] == 48 * operations
        assert found[name]["bytes"] > 48 * 4 * (64 + 3 * 32)  # what the first layers read and write
    assert found["rays"] == SmallNerf.rays
    step = found["step"]
    assert 0 < sum(wall for wall, _ in step["stages"].values()) <= step["seconds"]


def test_proposals_are_evaluations(device, scene):
    found = account(SmallMipNerf360, scene, WHITE, device, 0, 1)
    assert found["image"]["evaluations"] == 2 * 16 + 12


def test_tables_count_with_the_entries_that_are_read(device, scene):
    """Eight corners of two features at each level, of 4 B, whatever the size of the table."""
    field, work = SmallIngp(Space.of(scene.train), device, 0), Work()
    positions, table = device.empty("positions", (10, 3)), field.parameters["table"].values
    features = device.empty("features", (10, 32))
    work.count("hashgrid_fwd", (positions, table, field.levels), features)
    assert work.bytes == positions.nbytes + features.nbytes + 10 * 8 * 16 * 2 * 4


def test_stages_are_as_before_when_the_watch_ends(device, scene):
    field = SmallNerf(Space.of(scene.train), device, 0)
    before = dict(vars(field.stages))
    with pytest.raises(KeyError), watched(field):
        raise KeyError
    assert vars(field.stages) == before


def test_tables_have_a_row_for_each_method(device, scene, quick_roof):
    results = bench_fields([SmallNerf, SmallIngp], scene, WHITE, device, 1, 1, lambda text: None)
    text = fields_text(results)
    assert text.count("| nerf-small ") == 3 and text.count("| ingp-base ") == 3
    assert "mlp_bwd" in text and "pixel of an image" in text


def test_shares_are_written_without_exponents():
    """Bytes in a cache move faster than those of the roof, so that shares above 100 % are possible."""
    own = {"evaluations": 1, "operations": 2e3, "bytes": 5e3, "seconds": 1e-6, "cpu_seconds": 1e-6}
    own["stages"] = {"mlp_fwd": [9.97e-7, 9.97e-7]}
    results = {
        "device": {"label": "d", "compute_units": 1, "driver": "", "opencl": "", "kind": "cpu"},
        "software": {"clsplat": "1", "commit": None},
        "date": "",
        "load": None,
        "settings": {"repeats": 1, "iterations": 9},
        "roof": {"fma_gflops": 2.0, "copy_gbs": 4.0},
        "methods": [{"method": "m", "step": own, "image": own}],
    }
    text = fields_text(results)
    assert "125 %" in text and "mlp_fwd 100 %" in text and "e+" not in text


def test_the_command_prints_and_writes_the_same(data, tmp_path, capsys, monkeypatch, quick_roof):
    monkeypatch.setitem(METHODS, SmallNerf.name, SmallNerf)
    out = tmp_path / "fields.json"
    run("bench", "fields", data / "one", "--methods", "nerf-small", "--iterations", 1, "--repeats", 1, "-o", out)
    results = json.loads(out.read_text())
    assert results["benchmark"] == "fields" and results["methods"][0]["method"] == "nerf-small"
    assert np.isfinite(results["methods"][0]["step"]["seconds"])
    assert results["settings"] == {"iterations": 1, "repeats": 1, "scene": "one"}
    text = capsys.readouterr().out
    assert "| nerf-small " in text and "\n- after 1 iterations on one\n" in text
    assert "expected some of nerf" in fails(capsys, "bench", "fields", data / "one", "--methods", "nerd")
