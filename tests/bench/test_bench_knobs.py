"""`clsplat bench knobs`: each setting changes one knob, errors are relative to the float64 twin, and reports show the
measured figures.

No test depends on the speed of the machine.
"""

import itertools
import json
from dataclasses import asdict, replace
from typing import Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from matplotlib.figure import Figure

from clsplat.bench import knobs
from clsplat.bench.kernel_report import chart_title
from clsplat.bench.knob_report import FLOOR, knobs_chart, knobs_text
from clsplat.bench.knobs import Setting, bench_knobs, error, settings
from clsplat.bench.workloads import synthetic
from clsplat.camera import Camera
from clsplat.cli import main
from clsplat.config import RenderConfig
from clsplat.constants import ALPHA_MIN, TRANSMITTANCE_MIN
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.testing import synthetic_scene

WORKLOAD = "300-40x32"
FEWER = {"ALPHA_MINS": (2 * ALPHA_MIN, 8 * ALPHA_MIN), "TRANSMITTANCE_MINS": (100 * TRANSMITTANCE_MIN,)}


@pytest.fixture(scope="module")
def results(device):
    with pytest.MonkeyPatch.context() as patch:
        for name, value in FEWER.items():
            patch.setattr(knobs, name, value)
        return bench_knobs([synthetic(WORKLOAD)], RenderConfig(), device, 2)


def found(results, knob):
    return {r["value"]: r for r in results["workloads"][0]["results"] if r["knob"] == knob}


class TestModelOfADevice:
    """Constants of the rendering model, changed for one device."""

    @pytest.fixture
    def scene(self):
        """One Gaussian in the middle, four times as opaque as the threshold."""
        gaussians = synthetic_scene(1, seed=0)[0]
        gaussians.means[:] = [0, 0, 2]
        gaussians.log_scales[:] = np.log(0.5)
        gaussians.logit_opacities[:] = np.log(4 * ALPHA_MIN / (1 - 4 * ALPHA_MIN))
        gaussians.sh[:, 0] = 1
        return gaussians, Camera.look_at([0, 0, 0], [0, 0, 1], [0, -1, 0], 20, 32, 24)

    def test_alpha_min(self, scene, device):
        assert render(*scene, device=device).rgb.max() > 3 * ALPHA_MIN * 0.7
        for factor, empty in ((3.9, False), (4.1, True)):
            changed = Device(device.cl_device, model={"ALPHA_MIN": factor * ALPHA_MIN})
            assert (render(*scene, device=changed).rgb.max() == 0) == empty
        # Only pixels near the middle are drawn. The compositing kernel, which compares exponents, decides this.
        shown = render(*scene, device=Device(device.cl_device, model={"ALPHA_MIN": 2 * ALPHA_MIN})).alpha
        assert shown[shown > 0].min() >= 2 * ALPHA_MIN * (1 - 1e-5)
        assert shown.min() == 0

    def test_other_devices_keep_their_constants(self, scene, device):
        before = render(*scene, device=device).rgb
        render(*scene, device=Device(device.cl_device, model={"ALPHA_MIN": 8 * ALPHA_MIN}))
        np.testing.assert_array_equal(render(*scene, device=Device(device.cl_device)).rgb, before)

    def test_unknown_names_are_refused(self, device):
        with pytest.raises(InputError, match=r"model: expected names of ALPHA_MIN, .*, found ALPHA"):
            Device(device.cl_device, model={"ALPHA": 0.1})


class TestSettings:
    def test_each_setting_changes_one_knob(self, device):
        default, *others = settings(RenderConfig(), 3, device)
        assert default == Setting("default", "", RenderConfig())
        for setting in others:
            changed = {k for k, v in asdict(setting.render).items() if v != asdict(RenderConfig())[k]}
            changed |= {
                k for k in ("model", "sh_degree", "real", "optimizer") if getattr(setting, k) != getattr(default, k)
            }
            assert len(changed) == 1, setting
        assert len({(s.knob, s.value) for s in others}) == len(others)

    @pytest.mark.parametrize("base", [RenderConfig(), RenderConfig("antialiased", 8, "gpu", "per_tile")])
    def test_every_choice_of_the_configuration_is_one(self, device, base):
        turned = {(s.knob, s.value) for s in settings(base, 3, device)}
        for name, hint in get_type_hints(RenderConfig).items():
            for choice in get_args(hint) if get_origin(hint) is Literal else ():
                assert ((name, str(choice)) in turned) == (choice not in (getattr(base, name), "auto"))

    @pytest.mark.parametrize("base", [RenderConfig(projection="ray"), RenderConfig(sort="pixel")])
    def test_settings_that_exclude_each_other_are_left_out(self, device, base):
        """The renderer refuses the sort by pixel for the projection along rays: it ended the whole bench."""
        for setting in settings(base, 3, device):
            Renderer(device, setting.render)

    def test_degrees_below_the_stored_one(self, device):
        degrees = [s.sh_degree for s in settings(RenderConfig(), 2, device) if s.knob == "SH degree"]
        assert degrees == [0, 1]


def test_errors_are_those_of_the_formulas():
    truth = np.zeros((2, 2, 3))
    image = truth.copy()
    image[0, 1, 2] = -0.3
    rms = 0.3 / np.sqrt(12)
    expected = {"max_abs": 0.3, "rms": rms, "psnr": -20 * np.log10(rms)}
    assert error(image, truth) == pytest.approx(expected)
    assert error(truth, truth)["rms"] == 0


class TestResults:
    def test_knobs_without_an_effect_on_the_image(self, results):
        for knob in ("default", "tile_size", "sort", "compositor", "optimizer"):
            for value, result in found(results, knob).items():
                if value != "pixel":  # another order of the splats
                    assert 1e-9 < result["error"]["rms"] < 1e-5  # float32

    def test_knobs_that_reduce_accuracy(self, results):
        alphas = found(results, "ALPHA_MIN")
        assert 1e-4 < alphas["2 x"]["error"]["rms"] < alphas["8 x"]["error"]["rms"]
        assert found(results, "TRANSMITTANCE_MIN")["100 x"]["error"]["max_abs"] > 1e-3
        degrees = found(results, "SH degree")
        assert degrees["0"]["error"]["rms"] > degrees["1"]["error"]["rms"] > degrees["2"]["error"]["rms"] > 1e-3
        assert found(results, "mode")["antialiased"]["error"]["rms"] > 1e-3
        assert found(results, "sort")["pixel"]["error"]["rms"] > 1e-3

    def test_double_precision_is_the_twin(self, results):
        for result in found(results, "real").values():
            assert result["error"]["rms"] < 1e-12
            assert result["step"] is None

    def test_the_optimiser_does_not_render(self, results):
        assert found(results, "optimizer")["numpy"]["render"] is None
        assert found(results, "optimizer")["numpy"]["step"]["median_ms"] > 0

    def test_errors_are_of_the_images(self, results, device):
        workload = synthetic(WORKLOAD)
        camera, base = workload.view.camera, RenderConfig()
        truth = render(workload.gaussians, camera, base, device="reference").rgb
        image = render(workload.gaussians, camera, replace(base, mode="antialiased"), device).rgb
        measured = found(results, "mode")["antialiased"]["error"]
        assert measured["max_abs"] == pytest.approx(np.abs(image - truth).max())
        assert measured["rms"] == pytest.approx(np.sqrt(np.mean((image - truth) ** 2)))

    def test_ratios_are_of_neighbouring_runs(self, monkeypatch):
        """If each run takes twice the time of the one before, the ratio stays the same."""
        readings, now, speed = [], np.zeros(2), 1.0
        for _ in range(4):
            readings.append(now)
            for cost in (10.0, 30.0):
                now = now + speed * cost * np.array([1, 2])
                readings.append(now)
            speed *= 2
        monkeypatch.setattr(knobs, "clock", iter(readings).__next__)
        timed = knobs._paired(lambda: None, lambda: None, 3, None)
        assert timed["ratio"] == 3
        assert timed["median_ms"] == 1e3 * 30 * 4  # median of 2, 4 and 8: the first run is not timed


class TestReport:
    def test_the_table_shows_what_was_measured(self, results):
        text = knobs_text(results)
        assert results["date"] in text and results["device"]["label"] in text
        rows = [[c.strip() for c in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
        header, _, *body = rows
        for row, result in zip(body, results["workloads"][0]["results"], strict=True):
            cells = dict(zip(header, row, strict=True))
            assert (cells["knob"], cells["value"]) == (result["knob"], result["value"])
            for job in ("render", "step"):
                shown = cells[f"{job}, ratio"]
                assert shown == (f"{result[job]['ratio']:.2f}" if result[job] else "")
                if result[job]:
                    assert float(cells[f"{job}, ms"]) == pytest.approx(result[job]["median_ms"], rel=2e-3, abs=6e-4)
            assert float(cells["PSNR, dB"]) == pytest.approx(result["error"]["psnr"], abs=0.06)
            assert float(cells["largest error"]) == pytest.approx(result["error"]["max_abs"], rel=0.06)

    def test_the_chart_names_every_setting(self, results):
        figure = Figure()
        knobs_chart(results["workloads"][0], figure)
        for axes, job in zip(figure.axes, ("render", "step"), strict=True):
            shown = [r for r in results["workloads"][0]["results"] if r[job]]
            names = {f"{r['knob']} {r['value']}".rstrip() for r in shown}
            assert {t.get_text() for t in axes.texts} == names
            at = {t.get_text(): t.xy for t in axes.texts}
            # Labels are in the order of the errors, from below.
            errors = [at[t.get_text()][1] for t in sorted(axes.texts, key=lambda t: t.xyann[1])]
            assert all(below <= above * 1.1 for below, above in itertools.pairwise(errors))
            for r in shown:
                expected = r[job]["ratio"], max(r["error"]["rms"], FLOOR)
                assert at[f"{r['knob']} {r['value']}".rstrip()] == pytest.approx(expected)


class TestCommand:
    def test_files_and_table(self, tmp_path, capsys, monkeypatch):
        for name in FEWER:
            monkeypatch.setattr(knobs, name, ())
        monkeypatch.setattr(knobs, "RENDER_KNOBS", ("tile_size",))
        out, chart = tmp_path / "knobs.json", tmp_path / "knobs.png"
        main(["bench", "knobs", "--workload", "50-16x16", "--repeats", "1", "-o", str(out), "--chart", str(chart)])
        results = json.loads(out.read_text())
        assert results["benchmark"] == "knobs"
        assert knobs_text(results) in capsys.readouterr().out
        assert chart.read_bytes().startswith(b"\x89PNG")

    def test_invalid_input_is_refused(self, tmp_path, capsys):
        for arguments, message in (
            (["--repeats", "0"], "--repeats: expected an integer, 1 or more, found 0"),
            (["--scene", "a.ply"], "--scene and --cameras: expected both"),
            (["--workload", "huge"], "expected a number of Gaussians"),
            (["--chart", "chart.txt"], "--chart: expected a file named *.png"),
            (["-o", str(tmp_path / "missing" / "k.json")], "found no folder"),
        ):
            with pytest.raises(SystemExit) as exit_:
                main(["bench", "knobs", *arguments])
            assert exit_.value.code == 2
            assert message in capsys.readouterr().err


class TestPage:
    """docs/benchmarks.md shows the content of docs/results: its table is made from these files."""

    def test_table_and_chart_are_of_these_results(self, project, results):
        page = (project / "docs" / "benchmarks.md").read_text()
        assert "```{bench_knobs} results/knobs.json" in page
        assert "](results/knobs.svg)" in page
        measured = json.loads((project / "docs" / "results" / "knobs.json").read_text())
        assert set(measured) == set(results)
        assert {r["knob"] for r in measured["workloads"][0]["results"]} >= {"ALPHA_MIN", "SH degree", "optimizer"}
        assert measured["software"]["commit"], "figures without a commit cannot be repeated"
        chart = (project / "docs" / "results" / "knobs.svg").read_text()
        assert f"<dc:title>{chart_title(measured)}</dc:title>" in chart

    def test_make_writes_these_files(self, project):
        recipe = (project / "Makefile").read_text().split("\nbench-knobs:\n")[1].splitlines()[0]
        assert recipe.startswith("\t$(PYTHON) -m clsplat bench knobs ")
        assert recipe.endswith(" -o docs/results/knobs.json --chart docs/results/knobs.svg")
