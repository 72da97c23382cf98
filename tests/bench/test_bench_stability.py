"""`clsplat bench stability`: every row is measured or says why not, and names a test that exists."""

import ast
import json
import re

import pytest

from clsplat.bench.stability import EXPERIMENTS, run
from clsplat.bench.stability import stability_report as report
from clsplat.bench.stability.experiment import Experiment, Figure, Found, Plot
from clsplat.cli import main


def experiment(measure, remedy="a better sort", needs_data=False):
    return Experiment("a failure", "a paper", remedy, "tests/x.py::test_y", measure, "dB", needs_data)


def found(device, data):
    series = {"plain": [(1.0, 20.0), (10.0, float("nan"))], "better": [(1.0, 21.0), (10.0, 19.0)]}
    return Found([Figure("plain", 20.04, "dB"), Figure("better", 21.0, "dB")], Plot("size", "PSNR", series, "x"))


def broken(device, data):
    raise ValueError("no such luck")


@pytest.fixture
def rows(monkeypatch):
    """Experiments that take no time, one for each thing that may come of one."""
    table = {
        "good": experiment(found),
        "open": experiment(lambda device, data: Found([Figure("now", 7.0)]), remedy=None),
        "broken": experiment(broken),
        "scenes": experiment(found, needs_data=True),
    }
    for module in (run, report):
        monkeypatch.setattr(module, "EXPERIMENTS", table)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_names_a_test_that_exists(project, name):
    file, test = EXPERIMENTS[name].test.split("::")
    names = {node.name for node in ast.walk(ast.parse((project / file).read_text())) if hasattr(node, "name")}
    assert test in names


def test_rows_on_the_page_are_experiments(project):
    results = json.loads((project / "docs" / "results" / "stability.json").read_text())
    assert set(results) <= set(EXPERIMENTS), "remove rows of experiments that are no more"
    for name in report.charts(results):
        assert (project / "docs" / "results" / report.chart_file(name)).is_file()


def test_each_outcome_has_its_row(rows, device, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["bench", "stability", "-o", str(tmp_path)])
    shown = capsys.readouterr()
    assert "experiments failed, see above: broken" in shown.err and "no such luck" in shown.err
    lines = shown.out.splitlines()[2:]
    assert len(lines) == 4
    assert "| plain: 20.04 dB | better: 21 dB | a better sort |" in lines[0]
    assert "| now: 7 | **open** | none yet |" in lines[1]
    assert "| failed: ValueError: no such luck |" in lines[2]
    assert "| not run: needs real scenes: --data |" in lines[3]

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


def test_rows_that_are_not_measured_stay(rows, tmp_path):
    main(["bench", "stability", "scenes", "-o", str(tmp_path), "--data", str(tmp_path)])
    main(["bench", "stability", "good", "scenes", "-o", str(tmp_path)])
    results = json.loads((tmp_path / "stability.json").read_text())
    assert "figures" in results["scenes"] and "figures" in results["good"] and set(results) == {"good", "scenes"}


def test_bad_arguments_are_said_before_anything_is_measured(rows, tmp_path, capsys):
    for arguments, message in (
        (["nothing"], "nothing: expected experiments among good, open, broken, scenes"),
        (["-o", str(tmp_path / "none")], "none: expected a folder that exists"),
        (["--data", str(tmp_path / "none")], "none: expected a folder that exists"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["bench", "stability", *arguments])
        assert stopped.value.code == 2 and message in capsys.readouterr().err
    (tmp_path / "stability.json").write_text("[1")
    with pytest.raises(SystemExit):
        main(["bench", "stability", "-o", str(tmp_path)])
    assert re.search(r"stability\.json: expected results of an earlier run", capsys.readouterr().err)
    assert (tmp_path / "stability.json").read_text() == "[1"


def test_the_same_rows_draw_the_same_chart(rows, device, tmp_path):
    row = run.run_experiments(["good"], device, None)["good"]
    for name in ("a", "b"):
        report.save_chart("good", row, tmp_path / f"{name}.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
