"""`clsplat bench kernels`: the micro-benchmarks compute what they claim, and reports show the measured figures.

No test depends on the speed of the machine.
"""

import json
import re
import subprocess
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from cli_runs import fails
from matplotlib.figure import Figure

import clsplat
from clsplat import ops, reference
from clsplat.bench import networks as network_bench
from clsplat.bench import roof
from clsplat.bench.environment import commit
from clsplat.bench.kernel_report import chart_title, details, networks, scaling_chart, summary
from clsplat.bench.kernels import _watched, bench_kernels, stage_bytes
from clsplat.bench.timing import STILL, training_of
from clsplat.bench.workloads import DEFAULT, from_files, scaling_names, synthetic
from clsplat.cli import main
from clsplat.config import DataConfig, RenderConfig, TrainConfig
from clsplat.errors import InputError
from clsplat.formats import save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.testing import synthetic_scene
from clsplat.training.optimizer import Moments, adam_settings

STAGES = ("project_fwd", "bin_splats", "composite_fwd", "l1_ssim", "composite_bwd", "observe", "project_bwd_adam")


@pytest.fixture(scope="module")
def results(device):
    """Results of two tiny workloads."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"SECONDS": 1e-4, "RUNS": 1, "LAUNCHES": 5, "BUFFER_BYTES": 2**20}.items():
            patch.setattr(roof, name, value)
        patch.setattr(network_bench, "OPERATIONS", 2**17)
        return bench_kernels([synthetic("300-40x32"), synthetic("200-56x24")], RenderConfig(), device, 3)


def test_the_reference_workload_has_the_documented_counts(device):
    workload = synthetic("100k-640x480")
    run = Renderer(device, RenderConfig(tile_size=16)).forward(workload.gaussians, workload.view.camera, 0)
    accepted = ops.count_pairs(device, run.splats, run.bins)[1].get()
    # The scene was tuned to 62.0 pairs per pixel and 0.365 M intersections. Rounding changes single pairs.
    assert accepted.mean() == pytest.approx(62.0, abs=0.2)
    assert run.bins.gauss_ids.shape[0] == pytest.approx(365_000, rel=2e-3)


def test_networks_are_timed_and_reported(results):
    """Each network with its rates, as fractions of the roof; older files have no networks."""
    timed = results["networks"]
    assert [tuple(network["widths"]) for network in timed] == list(network_bench.WIDTHS)
    text = networks(results)
    for network in timed:
        share = network["backward_gflops"] / results["roof"]["fma_gflops"]
        assert f"{network['forward_gflops']:.4g}" in text and f"{100 * share:.3g} %" in text
    assert networks({"roof": results["roof"]}) == ""


class TestWorkloads:
    def test_the_scene_depends_on_the_number_alone(self):
        a, b = synthetic("1k-64x48"), synthetic("1000-128x72")
        assert len(a.gaussians) == len(synthetic("1k-9x8").gaussians) == 1000
        for name, array in a.gaussians.arrays().items():
            np.testing.assert_array_equal(array, getattr(b.gaussians, name))
        assert b.view.image.shape == (72, 128, 3)
        assert a.view.camera.fx / 64 == b.view.camera.fx / 128

    @pytest.mark.parametrize("name", ["", "100k", "0-64x48", "1m-64x48", "1k-64x0", "1k-64x48 ", "1.5k-64x48"])
    def test_other_names_are_refused(self, name):
        with pytest.raises(InputError, match="--workloads: expected a number of Gaussians and an image size"):
            synthetic(name)

    def test_a_scene_far_from_the_origin_meets_its_cameras(self, tmp_path):
        gaussians, camera = synthetic_scene(20)
        save_gaussians(tmp_path / "a.ply", gaussians.astype(np.float32), offset=(8.0, 0.0, -4.0))
        write_dataset(tmp_path / "data", camera, 2)
        workload = from_files(tmp_path / "a.ply", tmp_path / "data", 1, DataConfig())[0]
        np.testing.assert_allclose(workload.gaussians.means, gaussians.means + np.array([8, 0, -4]), atol=1e-5)

    def test_views_of_a_dataset(self, tmp_path):
        gaussians, camera = synthetic_scene(20)
        save_gaussians(tmp_path / "trained.ply", gaussians.astype(np.float32), "antialiased")
        write_dataset(tmp_path / "data", camera, 7)
        some = from_files(tmp_path / "trained.ply", tmp_path / "data", 3, DataConfig(test_every=0))
        assert [w.name for w in some] == ["trained: 1.png", "trained: 3.png", "trained: 5.png"]
        assert {w.mode for w in some} == {"antialiased"}
        np.testing.assert_allclose(some[0].view.camera.viewmat, camera.viewmat, atol=1e-12)
        assert len(from_files(tmp_path / "trained.ply", tmp_path / "data", 99, DataConfig(test_every=0))) == 7


def write_dataset(folder: Path, camera, count: int) -> None:
    """A transforms.json with black photos, all of one camera."""
    from PIL import Image

    folder.mkdir()
    frames = []
    for i in range(count):
        Image.new("RGB", (camera.width, camera.height)).save(folder / f"{i}.png")
        pose = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose.tolist()})
    intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    (folder / "transforms.json").write_text(json.dumps(intrinsics | {"frames": frames}))


class TestResults:
    def test_every_stage_and_kernel_is_there(self, results):
        for workload in results["workloads"]:
            assert tuple(workload["stages"]) == STAGES
            for name, stage in workload["stages"].items():
                assert stage["kernels"], f"{name} launched no kernel"
                for timed in (stage, *stage["kernels"].values(), workload["step"]):
                    assert 0 < timed["q1_ms"] <= timed["median_ms"] <= timed["q3_ms"]
        kernels = results["workloads"][0]["stages"]["project_bwd_adam"]["kernels"]
        assert kernels["project_bwd_adam"]["launches"] == 1

    def test_rates_follow_from_counts_and_times(self, results):
        top = results["roof"]
        for workload in results["workloads"]:
            counts, stages = workload["counts"], workload["stages"]
            assert 0 < counts["pairs_accepted"] < counts["pairs_evaluated"]
            assert 0 < counts["visible"] <= workload["gaussians"]
            for name in ("composite_fwd", "composite_bwd"):
                rate = counts["pairs_accepted"] / stages[name]["median_ms"] / 1e6
                assert stages[name]["gpairs_per_s"] == pytest.approx(rate)
                assert stages[name]["roof_fraction"] == pytest.approx(rate / max(top["exp_gops"], top["exp2_gops"]))
            pixels = workload["width"] * workload["height"]
            moved = stage_bytes(workload["gaussians"], 3, pixels, counts["intersections"])
            for name, size in moved.items():
                rate = size / stages[name]["median_ms"] / 1e6
                assert stages[name]["gb_per_s"] == pytest.approx(rate)
                assert stages[name]["roof_fraction"] == pytest.approx(rate / max(top["copy_gbs"], top["triad_gbs"]))
            both = stages["composite_fwd"]["median_ms"] + stages["composite_bwd"]["median_ms"]
            assert workload["step_over_compositing"] == pytest.approx(workload["step"]["median_ms"] / both)

    def test_results_describe_their_environment(self, results, device):
        assert results["device"]["label"] == device.label
        assert results["device"]["driver"] and results["device"]["opencl"].startswith("OpenCL ")
        assert results["settings"]["tile_size"] in (16, 32), "the one that was chosen"
        settings = asdict(RenderConfig()) | {"tile_size": results["settings"]["tile_size"]}
        assert results["settings"] == {"repeats": 3, **settings}
        assert json.loads(json.dumps(results)) == results

    def test_bytes_of_a_gaussian(self):
        # 59 parameters. Adam reads and writes them and two moments, and reads a gradient.
        assert stage_bytes(10, 3, 0, 0)["project_bwd_adam"] == 10 * 4 * (59 * 6 + 17)
        assert stage_bytes(10, 0, 0, 0)["project_fwd"] == 10 * 4 * (14 + 12)
        assert stage_bytes(0, 3, 100, 0)["l1_ssim"] == 100 * 27

    def test_steps_leave_the_scene_as_it_is(self):
        gaussians = synthetic_scene(30)[0].astype(np.float32)
        before = gaussians.astype(np.float32)
        gradients = Gaussians(**{name: np.ones_like(array) for name, array in gaussians.arrays().items()})
        moments = Moments.zeros(gaussians)
        for _ in range(3):
            settings = adam_settings(3001, 0.4, 1.0, STILL, 3)
            reference.adam_step(gaussians, gradients, moments.first, moments.second, settings)
        for name, array in gaussians.arrays().items():
            np.testing.assert_array_equal(array, getattr(before, name))
        assert moments.second.sh.all()

    @pytest.mark.parametrize("kernels", [False, True])
    def test_watching_ends(self, device, kernels):
        training = training_of(synthetic("1k-64x48"), TrainConfig(strategy="adc", size="fixed"), device)
        stages = training.renderer.stages
        before = dict(vars(stages))
        with pytest.raises(ZeroDivisionError), _watched(training, kernels):
            assert stages.project_fwd is not before["project_fwd"]
            raise ZeroDivisionError
        assert vars(stages) == before
        assert "launch" not in vars(device)

    def test_commit(self, project):
        installed = Path(clsplat.__file__).resolve().parents[1] != project.resolve()
        if installed or not (project / ".git").exists():
            assert commit() is None
            return
        head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=project, capture_output=True, text=True, check=True)
        assert (commit() or "").removesuffix("+") == head.stdout.strip()


class TestReport:
    def test_tables_are_aligned_and_show_what_was_measured(self, results):
        workload = results["workloads"][1]
        text = summary(results) + "\n\n" + details(workload)
        for block in text.split("\n\n"):
            widths = {len(line) for line in block.splitlines() if line.startswith("|")}
            assert len(widths) <= 1, block
        assert results["device"]["label"] in text and results["date"] in text
        assert results["software"]["commit"] is None or results["software"]["commit"] in text
        cells = {
            line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:-1]]
            for line in text.splitlines()
            if "|" in line
        }
        for name in STAGES:
            assert float(cells[name][0]) == pytest.approx(workload["stages"][name]["median_ms"], rel=2e-3, abs=6e-4)
            percent, limit = cells[name][4].split(" % ")
            assert float(percent) == pytest.approx(100 * workload["stages"][name]["roof_fraction"], rel=1e-2)
            assert limit == workload["stages"][name]["roof"]
        overview = cells["200-56x24"]
        assert float(overview[1]) == pytest.approx(workload["counts"]["pairs_accepted"] / (56 * 24), abs=0.051)
        assert float(overview[7]) == pytest.approx(workload["step_over_compositing"], abs=0.0051)
        assert "- bin_prepare" in cells and "- project_fwd" not in cells

    def test_the_chart_shows_every_stage_of_every_workload(self, results):
        tiny = results["workloads"][0]
        workloads = []
        for k, name in enumerate(scaling_names(), start=1):
            n, size = name.split("-")
            width, height = map(int, size.split("x"))
            count = int(n.replace("k", "000").replace("M", "000000"))
            stages = {s: v | {"median_ms": k / 10} for s, v in tiny["stages"].items()}
            shape = {"name": name, "gaussians": count, "width": width, "height": height}
            workloads.append(tiny | shape | {"step": {"median_ms": float(k)}, "stages": stages})
        figure = Figure()
        scaling_chart(results | {"workloads": workloads}, figure)
        left, right = figure.axes
        lines = {line.get_label(): line for line in left.lines}
        assert set(STAGES) | {"whole step"} <= set(lines)
        np.testing.assert_array_equal(lines["whole step"].get_xdata(), [1e4, 3e4, 1e5, 3e5, 1e6])
        np.testing.assert_array_equal(lines["whole step"].get_ydata(), [1, 2, 3, 4, 5])
        np.testing.assert_allclose(lines["l1_ssim"].get_ydata(), [0.1, 0.2, 0.3, 0.4, 0.5])
        pixels = {line.get_label(): line for line in right.lines}["whole step"]
        assert sorted(pixels.get_xdata())[2] == 640 * 480 and pixels.get_ydata()[2] == 3
        with pytest.raises(InputError, match="expected results of 100k-"):
            scaling_chart(results | {"workloads": workloads[:5]}, Figure())


class TestCommand:
    def fails(self, capsys, *arguments):
        with pytest.raises(SystemExit) as exit_:
            main(["bench", "kernels", *map(str, arguments)])
        assert exit_.value.code == 2
        return capsys.readouterr().err

    def test_json_and_table(self, tmp_path, capsys, quick_roof):
        out = tmp_path / "k.json"
        flags = ["--workloads", "100-20x20", "--repeats", "1", "-o", str(out)]
        flags += ["--tile-size", "8", "--compositor", "gpu", "--mode", "antialiased"]
        main(["bench", "kernels", *flags])
        written = json.loads(out.read_text())
        assert written["settings"]["tile_size"] == 8 and written["settings"]["compositor"] == "gpu"
        assert [(w["name"], w["mode"]) for w in written["workloads"]] == [("100-20x20", "antialiased")]
        printed = capsys.readouterr().out
        assert summary(written) in printed and details(written["workloads"][0]) in printed

    def test_a_scene_from_files(self, tmp_path, capsys, quick_roof):
        gaussians, camera = synthetic_scene(20)
        save_gaussians(tmp_path / "a.ply", gaussians.astype(np.float32))
        write_dataset(tmp_path / "data", camera, 2)
        files = ["--scene", str(tmp_path / "a.ply"), "--cameras", str(tmp_path / "data")]
        main(["bench", "kernels", *files, "--repeats", "1"])
        assert re.search(r"a: 1.png: 20 Gaussians .*SH degree 3, classic", capsys.readouterr().out)

    def test_invalid_input_is_refused(self, tmp_path, capsys):
        assert "--repeats: expected an integer, 1 or more, found 0" in self.fails(capsys, "--repeats", 0)
        assert "--scene and --cameras: expected both" in self.fails(capsys, "--scene", "a.ply")
        assert "expected a number of Gaussians" in self.fails(capsys, "--workloads", "huge")
        assert "--scaling: expected a file named *.png" in self.fails(capsys, "--scaling", "chart.txt")
        assert "found no folder" in self.fails(capsys, "-o", tmp_path / "missing" / "k.json")
        both = ("--scaling", tmp_path / "c.png", "--scene", "a.ply", "--cameras", tmp_path)
        assert "leave one of them out" in self.fails(capsys, *both)


@pytest.fixture
def measured(project):
    """The results that the page shows."""
    return json.loads((project / "docs" / "results" / "kernels.json").read_text())


@pytest.fixture
def page(project):
    return (project / "docs" / "benchmarks.md").read_text()


class TestPage:
    """docs/benchmarks.md shows the content of docs/results: its tables are made from these files."""

    def test_results_are_complete(self, project, measured, results):
        assert set(measured) | {"networks"} == set(results)  # the page shows no networks
        assert set(measured["roof"]) == set(results["roof"])
        made = re.search(r"^WORKLOADS = (.*)$", (project / "Makefile").read_text(), flags=re.M)[1].split()
        assert set(made) > set(DEFAULT)
        assert {w["name"] for w in measured["workloads"]} == {*made, *scaling_names()}
        assert set(measured["workloads"][0]) == set(results["workloads"][0])
        assert measured["software"]["commit"], "figures without a commit cannot be repeated"

    def test_tables_are_of_these_results(self, page, measured):
        shown = re.findall(r"^```{bench_kernels} (\S+) ?(\S*)$", page, flags=re.M)
        assert {file for file, _ in shown} == {"results/kernels.json"}
        assert {"", "100k-640x480"} <= {name for _, name in shown}
        by_name = {w["name"]: w for w in measured["workloads"]}
        assert f"{measured['date']}, {measured['settings']['repeats']} repeats" in summary(measured)
        for name in {name for _, name in shown} - {"", "model"}:
            assert details(by_name[name]).startswith(f"{name}: {by_name[name]['gaussians']:,} Gaussians")

    def test_the_chart_is_of_these_results(self, page, project, measured):
        assert "](results/kernels.svg)" in page
        text = (project / "docs" / "results" / "kernels.svg").read_text()
        assert f"<dc:title>{chart_title(measured)}</dc:title>" in text

    def test_make_bench_writes_these_files(self, project):
        recipe = (project / "Makefile").read_text().split("\nbench:\n")[1].split("\n\n")[0]
        assert recipe.split()[3:6] == ["bench", "kernels", "--workloads"]
        assert "-o docs/results/kernels.json" in recipe and "--scaling docs/results/kernels.svg" in recipe

    def test_bytes_are_those_of_the_page(self, page):
        values = {"N": 7, "P": 59, "M": 11}
        by_hand = {}
        for stage, formula in re.findall(r"^\| `(\w+)` \| ([^:|\n]+):", page, flags=re.M):
            formula = formula.replace("27 per pixel", "27 13")
            by_hand[stage] = eval(re.sub(r"(?<=[\w)]) (?=[\w(])", "*", formula), values)
        assert by_hand == stage_bytes(7, 3, 13, 11)


def test_no_workload_is_refused(capsys):
    assert "--workloads: expected at least one" in fails(capsys, "bench", "kernels", "--workloads")
