"""Variants of scenes, and the measures of overfitting."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cli_runs import fails, run, write_dataset
from walls import HEIGHT, WIDTH, scene_of, view

from clsplat.bench import measures
from clsplat.bench.captures import STANDARD, Capture, arc, captured, thinned, with_fewer_points
from clsplat.bench.cells import make_cells
from clsplat.bench.measures import measure, rare_share, training_psnr
from clsplat.bench.quality import Reader, run_cells
from clsplat.bench.results import read_records
from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.errors import InputError
from clsplat.metrics import psnr, to_uint8
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.testing import synthetic_scene


def names(views):
    return [v.name for v in views]


@pytest.fixture
def path():
    """20 photos along a line, every 5th of them held out."""
    views = [view(f"{i:02d}", x=0.1 * i) for i in range(20)]
    return scene_of([v for i, v in enumerate(views) if i % 5], views[::5])


class TestVariants:
    def test_thinning_keeps_every_nth_training_photo(self, path):
        found = thinned(path, 5)
        assert names(found.train) == ["01", "07", "13", "19"]
        assert found.test is path.test and found.points is path.points

    def test_too_few_photos_are_refused(self, path):
        assert len(thinned(path, 6).train) == 3
        with pytest.raises(InputError, match="thin=8: expected at least 3 training photos to remain, found 2"):
            thinned(path, 8)
        with pytest.raises(InputError, match=r"arc=0\.9: expected at least 3 training photos to remain, found 2"):
            arc(path, 0.9)

    def test_an_arc_is_the_end_of_the_path(self, path):
        found = arc(path, 0.2)
        assert names(found.test) == ["16", "17", "18", "19"]
        assert names(found.train) == [f"{i:02d}" for i in range(16)], "photos held out before are trained on"
        assert len(arc(path, 0.001).test) == 1

    def test_an_arc_includes_later_rounds_that_come_near(self):
        line = [view(f"{i:02d}", x=0.1 * (i % 10)) for i in range(20)]
        assert names(arc(scene_of(line, []), 0.2).test) == ["08", "09", "18", "19"]

    def test_photos_of_one_place_stay_together(self):
        pairs = [view(f"{i:02d}", x=0.1 * (i // 2)) for i in range(20)]
        assert names(arc(scene_of(pairs, []), 0.25).test) == [f"{i:02d}" for i in range(14, 20)]

    def test_fewer_points_are_spread_over_all(self, path):
        found = with_fewer_points(path, 0.1)
        assert len(found.points) == len(path.points) // 10
        index = np.flatnonzero((path.points[:, None] == found.points[None, :5]).all(axis=2).any(axis=1))
        assert index.tolist() == [0, 10, 20, 30, 40]
        assert (found.colors[:5] == path.colors[index]).all()
        assert found.train is path.train
        shown = with_fewer_points(replace(path, shown={"a": np.array([0, 5, 10, 21, 30])}), 0.1).shown
        assert shown["a"].tolist() == [0, 1, 3], "rows of the points that are left"
        some = scene_of(path.train, path.test, path.points[:7])
        assert len(with_fewer_points(some, 0.3).points) == 2
        assert len(with_fewer_points(some, 0.01).points) == 1
        with pytest.raises(InputError, match=r"points=0\.5: expected a scene with sparse points"):
            with_fewer_points(scene_of(path.train, path.test, np.zeros((0, 3))), 0.5)

    def test_all_options_apply(self, path):
        assert captured(path, Capture()) is path
        found = captured(path, Capture(thin=4, arc=0.2, points=0.5))
        assert names(found.train) == ["00", "04", "08", "12"]
        assert (len(found.test), len(found.points)) == (4, len(path.points) // 2)

    def test_kinds(self):
        kinds = [capture.kind for capture in STANDARD]
        assert kinds == ["full", "thinned", "thinned", "thinned", "arc", "fewer points"]
        assert Capture(thin=2, points=0.5).kind == "thinned and fewer points"


@pytest.fixture(scope="module")
def rendered(device):
    """Gaussians, three photos that differ from their renders by known amounts, and the renderer."""
    gaussians, camera = synthetic_scene(30, width=WIDTH, height=HEIGHT)
    gaussians = gaussians.astype(np.float32)
    image = to_uint8(render(gaussians, camera, device=device).rgb).astype(int)
    photos = [np.clip(image + d, 0, 255).astype(np.uint8) for d in (3, 9, 5)]
    return gaussians, [View(str(i), camera, photo) for i, photo in enumerate(photos)], image, Renderer(device)


class TestMeasures:
    def test_worst_is_the_lowest_psnr(self, rendered, tmp_path):
        gaussians, views, image, renderer = rendered
        each = [psnr(image.astype(np.uint8), v.image) for v in views]
        found = measure(gaussians, views, renderer, tmp_path)
        assert found["worst"] == each[1] == min(each)
        assert found["psnr"] == pytest.approx(np.mean(each))
        assert found["rare_psnr"] is None

    def test_rare_psnr_is_over_the_pixels_of_all_views(self, rendered, tmp_path):
        gaussians, views, image, renderer = rendered
        rng = np.random.default_rng(0)
        rare = [rng.random((HEIGHT, WIDTH)) < share for share in (0.5, 0.02, 0.0)]
        errors = [((image - v.image) / 255)[m] ** 2 for v, m in zip(views, rare, strict=True)]
        found = measure(gaussians, views, renderer, tmp_path, rare)
        assert found["rare_psnr"] == pytest.approx(-10 * np.log10(np.concatenate(errors).mean()))
        # A mask of the photo hides pixels.
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[: HEIGHT // 2] = True
        hidden = [replace(views[0], mask=mask), *views[1:]]
        errors[0] = ((image - views[0].image) / 255)[rare[0] & mask] ** 2
        found = measure(gaussians, hidden, renderer, tmp_path, rare)
        assert found["rare_psnr"] == pytest.approx(-10 * np.log10(np.concatenate(errors).mean()))
        assert rare_share(hidden, rare) == (rare[0] & mask).sum() / (2.5 * mask.size) + rare[1].sum() / (
            2.5 * mask.size
        )
        assert rare_share(views, None) is None

    def test_training_photos_are_evenly_spaced(self, rendered, monkeypatch):
        gaussians, views, _, renderer = rendered
        monkeypatch.setattr(measures, "TRAINING_PHOTOS", 3)
        asked = []
        monkeypatch.setattr(measures, "mean_metrics", lambda g, v, r, metrics: asked.append(v) or {"psnr": 1.0})
        assert training_psnr(gaussians, list(range(9)), renderer) == {"train_psnr": 1.0}
        training_psnr(gaussians, list(range(2)), renderer)
        assert asked == [[0, 4, 8], [0, 1]]
        monkeypatch.undo()
        expected = measure_psnr(gaussians, views, renderer)
        assert training_psnr(gaussians, views, renderer)["train_psnr"] == pytest.approx(expected)

    def test_equal_images_are_no_number(self, rendered, tmp_path):
        gaussians, views, image, renderer = rendered
        equal = [replace(views[0], image=image.astype(np.uint8))]
        found = measure(gaussians, equal, renderer, tmp_path, [np.ones((HEIGHT, WIDTH), bool)])
        assert (found["psnr"], found["worst"], found["rare_psnr"]) == (None, None, None)
        assert training_psnr(gaussians, equal, renderer) == {"train_psnr": None}


def measure_psnr(gaussians, views, renderer):
    return np.mean([psnr(render(gaussians, v.camera, device=renderer.device).rgb, v.image) for v in views])


SMALL = {"iterations": 2, "init": {"random_points": 60, "sh_degree": 0, "triangulate": False}}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    write_dataset(folder / "one", 12)
    (folder / "plain.json").write_text(json.dumps(SMALL))
    return folder


class TestBench:
    def test_trainings_see_the_variant(self, data, device, tmp_path):
        options = ["", ":thin=2", ":arc=0.25", ":thin=8", ":points=0.5"]
        cells = make_cells([f"{data / 'one'}{o}" for o in options], [str(data / "plain.json")], ["own"], [])
        run_cells(cells, device, tmp_path / "results.jsonl", lambda _: None)
        records = {r["scene"]: r for r in read_records(tmp_path / "results.jsonl")}
        photos = {name: (r.get("train"), r.get("test")) for name, r in records.items()}
        assert photos["one"] == (10, 2)
        assert photos["one:thin=2"] == (5, 2)
        assert photos["one:arc=0.25"] == (9, 3)
        assert "thin=8: expected at least 3" in records["one:thin=8"]["failed"]
        assert "points=0.5: expected a scene with sparse points" in records["one:points=0.5"]["failed"]
        last = records["one:arc=0.25"]
        assert last["worst"] <= last["psnr"]
        assert last["train_psnr"] > 0 and last["rare"] is None and last["rare_psnr"] is None

    def test_photos_are_read_once_for_all_variants(self, data, monkeypatch):
        read = []
        monkeypatch.setattr(
            "clsplat.bench.quality.load_scene", lambda path, config: read.append(path) or load_scene(path, config)
        )
        sources = [
            c.source
            for c in make_cells(
                [f"{data / 'one'}{o}" for o in ("", ":thin=2", ":test_every=3")], ["mcmc"], ["own"], []
            )
        ]
        reader = Reader()
        scenes = [reader.read(source)[0] for source in (*sources[:2], *sources[:2], sources[2])]
        assert len(read) == 2
        assert [len(scene.train) for scene in scenes] == [10, 5, 10, 5, 8]
        assert scenes[0].train[0].image is scenes[1].train[0].image

    def test_rare_pixels_are_those_of_all_points(self, data, monkeypatch):
        scene = load_scene(data / "one", DataConfig())
        points = np.random.default_rng(0).uniform(-0.6, 0.6, (400, 3))
        scene = replace(scene, points=points, colors=np.zeros((400, 3), np.uint8))
        monkeypatch.setattr("clsplat.bench.quality.load_scene", lambda *_: scene)
        cells = make_cells([f"{data / 'one'}{o}" for o in ("", ":points=0.1", ":thin=3")], ["mcmc"], ["own"], [])
        whole, fewer, thin = (Reader().read(c.source) for c in cells)
        assert len(fewer[0].points) == 40
        assert all((a == b).all() for a, b in zip(whole[1], fewer[1], strict=True))
        assert rare_share(thin[0].test, thin[1]) > rare_share(whole[0].test, whole[1])


def test_the_command(data, tmp_path, capsys, monkeypatch):
    """Each standard variant of each scene, once."""

    def run_cell(config, scene, device, record, rare):
        figures = {
            "photos": measures.digest_of(scene),
            "psnr": float(len(scene.train)),
            "ssim": 0.5,
            "flip": None,
            "worst": 1.0,
            "rare_psnr": None,
            "best": 9.0,
        }
        costs = {
            "iteration": 2,
            "seconds": 1.0,
            "cpu_seconds": 1.0,
            "num_gaussians": 5,
            "train_psnr": 9.0,
            "fps": 1.0,
        }
        record(figures | costs)
        return figures | costs

    monkeypatch.setattr("clsplat.bench.quality.run_cell", run_cell)
    arguments = ["bench", "captures", data / "one", f"{data / 'one'}:test_every=4", "--methods", data / "plain.json"]
    run(*arguments, "--seeds", 3, "-o", tmp_path / "out")
    said = capsys.readouterr()
    records = read_records(tmp_path / "out" / "results.jsonl")
    assert {r["seed"] for r in records} == {3}
    expected = {f"one{o}{c.options}" for o in ("", ":test_every=4") for c in STANDARD}
    assert {r["scene"] for r in records} == expected
    text = (tmp_path / "out" / "captures.md").read_text()
    assert said.out.strip() in text and "| one:thin=4 | plain · 2 it | 3.00 | 0.500 |" in text
    assert text.startswith(f"- {records[0]['device']}, ") and f"clsplat {records[0]['version']}, commit" in text
    assert "requires two scenes" in said.out, "both are of the same scene"
    finished = [r for r in records if "failed" not in r]
    run(*arguments, "--seeds", 3, "-o", tmp_path / "out")
    assert f"{len(finished)} of {len(records)} trainings are already finished" in capsys.readouterr().err
    assert [r for r in read_records(tmp_path / "out" / "results.jsonl") if "failed" not in r] == finished
    assert "no options for a variant" in fails(capsys, "bench", "captures", f"{data / 'one'}:arc=0.1")
