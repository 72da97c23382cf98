"""`clsplat bench quality`: trainings, their records, interruptions and failures."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cli_runs import SIZE, fails, run, write_dataset
from PIL import Image
from small_cells import ITERATIONS, cells_of
from small_fields import SmallNerf

from clsplat.bench import measures, quality
from clsplat.bench.cells import make_cells
from clsplat.bench.measures import digest_of, sample_iterations
from clsplat.bench.quality import run_cell, run_cells
from clsplat.bench.quality_summary import COSTS
from clsplat.bench.results import append_record, read_records, write_records
from clsplat.config import UINT64_MAX, AdcConfig, DataConfig
from clsplat.dataset import load_scene
from clsplat.errors import InputError
from clsplat.fields import METHODS
from clsplat.formats import save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr
from clsplat.render import render
from clsplat.renderer import Renderer


@pytest.fixture(scope="module")
def trained(data, device):
    """A cell with its records, and the Gaussians of each record."""
    (cell,) = cells_of(data, "plain")
    scene = load_scene(cell.source.path, cell.source.data)
    records, states = [], []

    def measured(gaussians, *arguments, real=quality.measure):
        states.append(gaussians)
        return real(gaussians, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quality, "measure", measured)
        last = run_cell(cell.config, scene, device, records.append)
    assert last == records[-1]
    return cell, scene, records, states


class TestOneTraining:
    def test_samples_are_where_they_should_be(self, trained):
        _, _, records, _ = trained
        assert [r["iteration"] for r in records] == sample_iterations(ITERATIONS)
        for name in ("fps", "train_psnr"):
            assert [name in r for r in records] == [False] * (len(records) - 1) + [True]
        assert [r["best"] for r in records] == np.maximum.accumulate([r["psnr"] for r in records]).tolist()
        seconds = [r["seconds"] for r in records]
        assert seconds == sorted(seconds) and seconds[0] > 0
        assert all((r["train"], r["test"], r["width"], r["height"]) == (7, 2, 40, 32) for r in records)

    def test_figures_are_those_of_the_gaussians(self, trained, device, tmp_path):
        _, scene, records, states = trained
        for record, gaussians in zip(records, states, strict=True):
            shown = [render(gaussians, view.camera, device=device).rgb for view in scene.test]
            expected = np.mean([psnr(rgb, view.image) for rgb, view in zip(shown, scene.test, strict=True)])
            assert record["psnr"] == pytest.approx(expected)
            assert 0 < record["ssim"] < 1
            assert record["num_gaussians"] == len(gaussians)
            for suffix in ("ply", "spz"):
                save_gaussians(tmp_path / f"a.{suffix}", gaussians)
                assert record[f"{suffix}_bytes"] == (tmp_path / f"a.{suffix}").stat().st_size
        assert records[-1]["psnr"] > records[0]["psnr"]
        assert len({record["psnr"] for record in records}) == len(records)

    def test_memory_is_that_of_training(self, trained):
        _, _, records, _ = trained
        parameters = 4 * 150 * (11 + 3 * 4)
        photos = 7 * 40 * 32 * 3
        assert all(r["memory_bytes"] > 3 * parameters + photos for r in records)
        assert [r["memory_bytes"] for r in records] == sorted(r["memory_bytes"] for r in records)

    def test_evaluations_do_not_count_as_time(self, trained, device, monkeypatch):
        cell, scene, _, _ = trained
        clock = SimpleNamespace(now=100.0)
        monkeypatch.setattr(
            quality, "time", SimpleNamespace(perf_counter=lambda: clock.now, process_time=lambda: clock.now)
        )
        monkeypatch.setattr(quality, "frames_per_second", lambda *_: 1.0)
        monkeypatch.setattr(quality, "training_psnr", lambda *_: {})
        some = Gaussians(*(np.zeros(0) for _ in range(5)))

        def training(scene, config, device, out, *, evaluate=None, evaluate_after=(), progress=None):
            for iteration in range(1, config.iterations + 1):
                clock.now += 2  # an iteration takes 2 s
                if evaluate and iteration in evaluate_after:
                    evaluate(some)
            return some

        def measured(*_):
            clock.now += 1000
            return {"psnr": falling.pop()}

        falling = list(np.arange(measures.SAMPLES, dtype=float))
        monkeypatch.setattr(quality, "train", training)
        monkeypatch.setattr(quality, "measure", measured)
        records = []
        run_cell(cell.config, scene, device, records.append)
        assert {r["best"] for r in records} == {measures.SAMPLES - 1.0}
        assert [r["seconds"] for r in records] == [2 * r["iteration"] for r in records]

    def test_frames_per_second_is_of_the_median(self, trained, device, monkeypatch):
        _, scene, _, _ = trained
        clock = SimpleNamespace(now=0.0)
        monkeypatch.setattr(
            measures, "time", SimpleNamespace(perf_counter=lambda: clock.now, process_time=lambda: clock.now)
        )

        def renderings(renderer, gaussians, cameras):
            for i, _ in enumerate(cameras):
                # The first round is slow, and so are a few later ones.
                clock.now += 7.0 if i < len(scene.test) or i % 4 == 0 else 0.25
                yield object()

        monkeypatch.setattr(measures, "renderings", renderings)
        assert measures.frames_per_second(None, scene.test, Renderer(device)) == 4.0


class TestBench:
    def start(self, data, device, path, *methods, scenes=("one",)):
        said = []
        run_cells(cells_of(data, *methods, scenes=scenes), device, path, said.append)
        return read_records(path), said

    def test_finished_trainings_are_not_repeated(self, data, device, tmp_path, monkeypatch):
        path = tmp_path / "results.jsonl"
        records, _ = self.start(data, device, path, "plain")
        assert {r["device"] for r in records} == {device.label}
        for name in ("driver", "commit", "date", "settings", "scene", "method", "load"):
            assert all(name in r for r in records), name
        before = path.read_bytes()
        monkeypatch.setattr(quality, "run_cell", lambda *_: pytest.fail("trained again"))
        assert self.start(data, device, path, "plain")[0] == records
        assert path.read_bytes() == before
        # A failure of another cell keeps its records, too.
        monkeypatch.setattr(quality, "run_cell", lambda *_: 1 / 0)
        again, _ = self.start(data, device, path, "plain", "capped")
        assert again[:-1] == records
        assert again[-1]["failed"] == "ZeroDivisionError: division by zero"

    def test_interrupted_trainings_run_again(self, data, device, tmp_path):
        path = tmp_path / "results.jsonl"
        records, _ = self.start(data, device, path, "plain", "capped")
        cut = path.read_text().rindex("\n", 0, -1)
        path.write_text(path.read_text()[: cut + 20])  # within the last line
        again, said = self.start(data, device, path, "plain", "capped")
        assert said[0].startswith("1 of 2 ")
        assert len(again) == len(records)
        first = len([r for r in records if r["method"] == "plain"])
        assert again[:first] == records[:first]
        assert [r["psnr"] for r in again] == [r["psnr"] for r in records], "runs repeat to the bit"

    def test_other_settings_replace_the_records(self, data, device, tmp_path):
        path = tmp_path / "results.jsonl"
        records, _ = self.start(data, device, path, "plain")
        (cell,) = cells_of(data, "plain")
        changed = replace(cell, config=replace(cell.config, adc=AdcConfig(every=7)))
        run_cells([changed], device, path, lambda _: None)
        again = read_records(path)
        assert len(again) == len(records)
        assert all(r["settings"]["adc"] == {"every": 7} for r in again)

    def test_other_photos_replace_the_records(self, data, device, tmp_path):
        """A folder of the same name elsewhere, or with another photo, is another dataset."""
        path = tmp_path / "results.jsonl"
        records, _ = self.start(data, device, path, "plain")
        shutil.copytree(data, tmp_path / "copy")
        copied = tmp_path / "copy"
        assert self.start(copied, device, path, "plain")[1][0].startswith("1 of 1 ")
        photo = copied / "one" / "3.png"
        Image.open(photo).point(lambda value: 255 - value).save(photo)
        again, said = self.start(copied, device, path, "plain")
        assert said[0].startswith("0 of 1 ")
        assert len(again) == len(records)
        assert {r["photos"] for r in again}.isdisjoint({r["photos"] for r in records})

    def test_results_are_kept_without_their_dataset(self, data, device, tmp_path):
        path = tmp_path / "results.jsonl"
        shutil.copytree(data, tmp_path / "copy")
        records, _ = self.start(tmp_path / "copy", device, path, "plain")
        shutil.rmtree(tmp_path / "copy" / "one")
        again, said = self.start(tmp_path / "copy", device, path, "plain")
        assert said[0].startswith("1 of 1 ") and again == records

    def test_streamed_photos_keep_their_digest_once_they_are_read(self, data):
        scene = load_scene(data / "one", DataConfig(), memory=0)
        before = digest_of(scene)
        assert all(view.ahead for view in scene.train)
        assert [view.image.shape for view in scene.train] and scene.train[0].digests
        assert digest_of(scene) == before

    def test_a_seed_keeps_the_records_of_the_others(self, data, device, tmp_path):
        path = tmp_path / "results.jsonl"
        records, _ = self.start(data, device, path, "plain")
        cells = make_cells([str(data / "one")], [str(data / "plain.json")], ["own"], [], seeds=[0, 1])
        said = []
        run_cells(cells, device, path, said.append)
        assert said[0].startswith("1 of 2 ")
        again = read_records(path)
        assert again[: len(records)] == records
        assert [r["seed"] for r in again] == [0] * len(records) + [1] * len(records)
        assert again[-1]["psnr"] != records[-1]["psnr"]

    def test_interruption_ends_it(self, data, device, tmp_path, monkeypatch):
        def interrupted(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(quality, "run_cell", interrupted)
        with pytest.raises(KeyboardInterrupt):
            self.start(data, device, tmp_path / "results.jsonl", "plain")

    def test_failures_are_results(self, data, device, tmp_path):
        write_dataset(tmp_path / "corrupt")
        photo = tmp_path / "corrupt" / "3.png"
        photo.write_bytes(photo.read_bytes()[:100])
        (tmp_path / "empty").mkdir()
        path = tmp_path / "results.jsonl"
        scenes = [
            str(tmp_path / "corrupt"),
            str(tmp_path / "empty"),
            f"{data / 'one'}:test_every=0",
            str(data / "one"),
        ]
        methods = [str(data / "plain.json"), str(data / "capped.json")]
        cells = make_cells(scenes, methods, ["own"], [])
        run_cells(cells, device, path, lambda _: None)
        by_scene = {}
        for r in read_records(path):
            by_scene.setdefault(r["scene"], []).append(r)
        assert [r["failed"].startswith("cannot read corrupt/3.png as an image") for r in by_scene["corrupt"]] == [
            True,
            True,
        ]
        assert ["found none" in r["failed"] for r in by_scene["empty"]] == [True, True]
        assert ["held-out" in r["failed"] for r in by_scene["one:test_every=0"]] == [True, True]
        assert sum("fps" in r for r in by_scene["one"]) == 2

    def test_insufficient_memory_is_a_result(self, data, device, tmp_path):
        cells = make_cells([str(data / "one")], [str(data / "plain.json")], ["own"], [], memory_limit="0.1MB")
        run_cells(cells, device, tmp_path / "results.jsonl", lambda _: None)
        (record,) = read_records(tmp_path / "results.jsonl")
        assert "--memory-limit" in record["failed"]

    def test_a_reason_does_not_name_the_folders_around_the_dataset(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        error = InputError(f"3.png: 0.5 MB in {tmp_path / 'a'}, not in a/3.png. See x/a.")
        assert quality._reason(error, Path("x/a")) == f"3.png: 0.5 MB in {tmp_path / 'a'}, not in a/3.png. See a."
        assert quality._reason(error, Path("a")) == "3.png: 0.5 MB in a, not in a/3.png. See x/a."
        assert quality._reason(InputError(f"3.png: 0.5 MB in {tmp_path}."), Path(".")) == (
            f"3.png: 0.5 MB in {tmp_path.name}."
        )

    def test_images_without_error_are_results(self, device, tmp_path, monkeypatch):
        """Black photos are learned exactly: an infinite PSNR is null, and the training has not failed."""
        write_dataset(tmp_path / "black")
        for photo in (tmp_path / "black").glob("*.png"):
            Image.new("RGB", SIZE).save(photo)
        fast = {"optim": {"sh0_lr": 0.5}, "init": {"random_points": 20, "sh_degree": 0}}
        (tmp_path / "fast.json").write_text(json.dumps(fast))
        monkeypatch.setitem(METHODS, SmallNerf.name, SmallNerf)
        cells = make_cells([str(tmp_path / "black")], [str(tmp_path / "fast.json"), SmallNerf.name], ["own"], [60])
        path, said = tmp_path / "results.jsonl", []
        run_cells(cells, device, path, said.append)
        records = read_records(path)
        assert not [r["failed"] for r in records if "failed" in r]
        for last in (r for r in records if "fps" in r):
            assert (last["psnr"], last["ssim"], last["train_psnr"]) == (None, 1, None)
        assert sum("    no error, SSIM 1.000" in text for text in said) == 2

    def test_a_failure_is_tried_again(self, data, device, tmp_path, monkeypatch):
        path = tmp_path / "results.jsonl"
        with monkeypatch.context() as patch:
            patch.setattr(quality, "run_cell", lambda *_: 1 / 0)
            assert len(self.start(data, device, path, "plain")[0]) == 1
        assert all("psnr" in r for r in self.start(data, device, path, "plain")[0])


def test_the_file_of_results(tmp_path):
    path = tmp_path / "results.jsonl"
    assert read_records(path) == []
    record = {"scene": "a", "method": "b", "max_gaussians": None, "iterations": 3, "device": "c"}
    record["seed"] = UINT64_MAX  # the largest that --seeds takes
    write_records(path, [record])
    append_record(path, record | {"psnr": 1.5})
    with path.open("a") as file:
        file.write('{"scene": "a", "met')
    assert read_records(path) == [record, record | {"psnr": 1.5}]
    with pytest.raises(ValueError):
        append_record(path, record | {"psnr": float("nan")})
    path.write_text('{"scene": "a"}\n')
    with pytest.raises(InputError, match=r"results\.jsonl, line 1: expected a record"):
        read_records(path)


def test_the_command(data, tmp_path, capsys, monkeypatch):
    # A chart takes a second, so only one cost is drawn.
    monkeypatch.setattr("clsplat.bench.charts_page.COSTS", {"seconds": COSTS["seconds"]})
    run("bench", "quality", data / "one", "--methods", data / "plain.json", "-o", tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"results.jsonl", "index.html", "time-psnr.png", "time-psnr.svg", "published-ssim.svg"} <= names
    assert "    " in capsys.readouterr().err
    assert "--budgets" in fails(capsys, "bench", "quality", data / "one", "--budgets", "half", "-o", tmp_path / "no")
    assert "results.jsonl" in fails(capsys, "bench", "chart", tmp_path)
    assert not (tmp_path / "no").exists()
