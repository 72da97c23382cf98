"""`clsplat bench stability`, and the same runner on the experiments that need real scenes."""

import ast
import json
import re

import pytest
from measure_scenes import main as measure_scenes
from scene_experiments import ALL_EXPERIMENTS, SCENE_EXPERIMENTS

from clsplat.bench.stability import EXPERIMENTS, run
from clsplat.bench.stability import stability_report as report
from clsplat.bench.stability.experiment import Experiment, Figure, Found, Plot
from clsplat.cli import main


def experiment(measure, remedy="a better sort"):
    return Experiment("a failure", "a paper", remedy, "tests/x.py::test_y", measure, "dB")


def found(device):
    series = {"plain": [(1.0, 20.0), (10.0, float("nan"))], "better": [(1.0, 21.0), (10.0, 19.0)]}
    return Found([Figure("plain", 20.04, "dB"), Figure("better", 21.0, "dB")], Plot("size", "PSNR", series, "x"))


def broken(device):
    raise ValueError("no such value")


@pytest.fixture
def table(monkeypatch):
    """Replace the packaged experiments by quick ones, one for each outcome."""
    table = {
        "good": experiment(found),
        "open": experiment(lambda device: Found([Figure("now", 7.0)]), remedy=None),
        "broken": experiment(broken),
    }
    for name in list(EXPERIMENTS):
        monkeypatch.delitem(EXPERIMENTS, name)
    for name, row in table.items():
        monkeypatch.setitem(EXPERIMENTS, name, row)
    return table


@pytest.fixture
def on_scenes(monkeypatch):
    """Replace the experiments on real scenes by a quick one."""

    def measured(device, data):
        return Found([Figure("scenes in the folder", float(len(list(data.iterdir()))))])

    for name in list(SCENE_EXPERIMENTS):
        monkeypatch.delitem(SCENE_EXPERIMENTS, name)
    monkeypatch.setitem(SCENE_EXPERIMENTS, "scenes", experiment(measured))


@pytest.mark.parametrize("name", ALL_EXPERIMENTS)
def test_every_experiment_names_a_test_that_exists(project, name):
    file, test = ALL_EXPERIMENTS[name].test.split("::")
    names = {node.name for node in ast.walk(ast.parse((project / file).read_text())) if hasattr(node, "name")}
    assert test in names


def test_rows_on_the_page_are_experiments(project):
    results = json.loads((project / "docs" / "results" / "stability.json").read_text())
    assert set(results) <= set(ALL_EXPERIMENTS), "remove rows of experiments that no longer exist"
    for name in report.charts(results, ALL_EXPERIMENTS):
        assert (project / "docs" / "results" / report.chart_file(name)).is_file()


def test_each_outcome_has_its_row(table, device, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["bench", "stability", "-o", str(tmp_path)])
    shown = capsys.readouterr()
    assert "experiments failed, see above: broken" in shown.err and "no such value" in shown.err
    lines = shown.out.splitlines()[2:]
    assert len(lines) == 3
    assert "| plain: 20.04 dB | better: 21 dB | a better sort |" in lines[0]
    assert "| now: 7 | **open** | none yet |" in lines[1]
    assert "| failed: ValueError: no such value |" in lines[2]

    results = json.loads((tmp_path / "stability.json").read_text())
    assert results["good"]["figures"] == [
        {"label": "plain", "value": 20.04, "unit": "dB"},
        {"label": "better", "value": 21.0, "unit": "dB"},
    ]
    assert results["good"]["plot"]["series"]["plain"] == [[1.0, 20.0], [10.0, None]]
    assert {"date", "commit", "device", "seconds"} <= set(results["good"])
    chart = (tmp_path / "stability-good.svg").read_text()
    assert "svg" in chart
    origin = report.origin(results)
    assert origin.count("\n") == 0 and origin.endswith(": good, open") and device.label in origin


def test_rows_that_are_not_measured_stay(table, tmp_path, capsys):
    tmp_path /= "new"
    main(["bench", "stability", "open", "-o", str(tmp_path)])
    before = json.loads((tmp_path / "stability.json").read_text())
    capsys.readouterr()
    main(["bench", "stability", "good", "-o", str(tmp_path)])
    results = json.loads((tmp_path / "stability.json").read_text())
    assert set(results) == {"good", "open"} and results["open"] == before["open"]
    assert "| not measured yet |" in capsys.readouterr().out.splitlines()[-1]


def test_packaged_rows_and_rows_of_scenes_share_a_file(table, on_scenes, tmp_path, capsys):
    (tmp_path / "data" / "fern").mkdir(parents=True)
    for _ in range(2):
        main(["bench", "stability", "good", "-o", str(tmp_path)])
        measure_scenes(["--data", str(tmp_path / "data"), "-o", str(tmp_path)])
        assert "| scenes in the folder: 1 |" in capsys.readouterr().out
        results = json.loads((tmp_path / "stability.json").read_text())
        assert set(results) == {"good", "scenes"} and all("figures" in row for row in results.values())


def test_scenes_that_are_missing_fail(tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        measure_scenes(["dead-gaussians", "--data", str(tmp_path)])
    assert stopped.value.code == 1 and "experiments failed, see above: dead-gaussians" in capsys.readouterr().err


def test_bad_arguments_are_reported_before_anything_is_measured(table, tmp_path, capsys):
    (tmp_path / "file").touch()
    for arguments, message in (
        (["nothing"], "nothing: expected experiments among good, open, broken"),
        (["-o", str(tmp_path / "file" / "none")], "none: Not a directory"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["bench", "stability", *arguments])
        assert stopped.value.code == 2 and message in capsys.readouterr().err
    with pytest.raises(SystemExit) as stopped:
        measure_scenes(["--data", str(tmp_path / "none")])
    assert stopped.value.code == 2 and "none: expected a folder that exists" in capsys.readouterr().err
    (tmp_path / "stability.json").write_text("[1")
    with pytest.raises(SystemExit):
        main(["bench", "stability", "-o", str(tmp_path)])
    assert re.search(r"stability\.json: expected results of an earlier run", capsys.readouterr().err)
    assert (tmp_path / "stability.json").read_text() == "[1"


def test_the_same_rows_draw_the_same_chart(table, device, tmp_path):
    row = run.run_experiments(["good"], device)["good"]
    for name in ("a", "b"):
        report.save_chart("good", row, tmp_path / f"{name}.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
