"""Charts of `clsplat bench quality`: Pareto fronts, means, positions of labels, and the page."""

import json
import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from clsplat.bench import charts
from clsplat.bench import charts_page as page
from clsplat.bench.charts import published_chart, published_table, quality_chart, read_published
from clsplat.bench.quality_summary import (
    COSTS,
    MEAN,
    METRICS,
    best_settings,
    failures,
    front,
    means,
    measured_metrics,
    origins,
    panels,
    runs,
    short,
    table,
    verdict,
)

SCENES = ("fox:downscale=2", "lego:background=white")


def record(scene="fox", method="fast", cap=None, iterations=8, device="here", **values):
    key = {
        "scene": scene,
        "method": method,
        "max_gaussians": cap,
        "iterations": iterations,
        "seed": 0,
        "device": device,
    }
    about = {"driver": "3", "compute_units": 2, "version": "1", "commit": "abc", "load": 0.5, "date": "2026-11-21T10"}
    return key | about | values


def training(scene, method, cap, seconds, psnr, gaussians=1000, fps=30.0, iterations=8, device="here"):
    """Records of one training, sampled three times."""
    return [
        record(
            scene,
            method,
            cap,
            iterations,
            device,
            **{
                "iteration": iterations * k // 4,
                "seconds": seconds * k / 4,
                "cpu_seconds": seconds * k / 2,
                "num_gaussians": gaussians * k // 4,
            },
            **{"ply_bytes": 248 * gaussians, "spz_bytes": 23 * gaussians, "memory_bytes": 10**6 + 900 * gaussians},
            **{"psnr": psnr - (4 - k), "ssim": psnr / 40 - (4 - k) / 100, "flip": None},
            **({"fps": fps} if k == 4 else {}),
        )
        for k in (1, 2, 4)
    ]


@pytest.fixture
def records():
    """Two methods, one of them with two caps, on two scenes; a training that failed, and one that is not finished."""
    found = []
    for scene, shift in zip(SCENES, (0, 2), strict=True):
        found += training(scene, "paper-7k", None, 100, 28 + shift, 4000, fps=10)
        found += training(scene, "fast", 500, 10, 26 + shift, 500, fps=60)
        found += training(scene, "fast", 1000, 20, 27 + shift, 1000, fps=30)
        found += training(scene, "bad", None, 200, 25 + shift, 8000, fps=5)
    found.append(record("two", failed="two: expected 3 photos, found 2"))
    return found + training("fox:downscale=2", "mcmc", 7, 1, 99)[:-1]


def test_the_front_is_what_no_point_dominates():
    rng = np.random.default_rng(0)
    for _ in range(50):
        points = [tuple(map(float, p)) for p in rng.integers(0, 6, (8, 2))]
        expected = {
            i for i, (x, y) in enumerate(points) if not any(u <= x and v <= y and (u < x or v < y) for u, v in points)
        }
        assert set(front(points)) == expected, points
        assert [points[i] for i in front(points)] == sorted(points[i] for i in front(points))
    assert front([]) == []


def test_unfinished_trainings_are_not_results(records):
    found = runs(records)
    assert len(found) == 8
    assert not any(run.method == "mcmc" for run in found)
    assert [s["iteration"] for s in found[0].samples] == [2, 4, 8]
    assert runs(records[::-1])[0].samples[-1]["iteration"] == 8
    assert failures(records) == [("two, fast · 8 it", "two: expected 3 photos, found 2")]


def test_names_of_methods_include_the_device(records):
    records += training("fox:downscale=2", "fast", 500, 3, 26, device="there")
    assert {"fast (here)", "fast (there)"} <= {run.method for run in runs(records)}


def test_settings_that_are_nearly_equal_are_not_seeds_of_one():
    found = training("a", "m", 40_010, 1, 20, iterations=1001) + training("a", "m", 40_010, 1, 30, iterations=1002)
    found += training("a", "m", 40_020, 1, 25, iterations=1001)
    assert {run.setting: run.last["psnr"] for run in runs(found)} == {
        "m · ≤40.01k · 1.001k it": 20,
        "m · ≤40.01k · 1.002k it": 30,
        "m · ≤40.02k · 1.001k it": 25,
    }


def test_means_are_over_settings_that_all_scenes_have(records):
    found = runs([*records, *training(SCENES[0], "fast", 99, 1, 20)])
    by_setting = {run.setting: run for run in means(found)}
    assert set(by_setting) == {"paper-7k · 8 it", "fast · ≤500 · 8 it", "fast · ≤1k · 8 it", "bad · 8 it"}
    last = by_setting["fast · ≤500 · 8 it"].last
    assert (last["psnr"], last["seconds"], last["num_gaussians"], last["flip"]) == (27, 10, 500, None)
    assert by_setting["fast · ≤500 · 8 it"].samples[0]["psnr"] == 24
    some = runs([*training("a", "m", None, 1, 20, fps=10), *training("b", "m", None, 1, 20, fps=30)])
    assert means(some)[0].last["fps"] == pytest.approx(15), "of the mean time of a frame"


def test_panels(records):
    found = runs(records)
    assert list(panels(found)) == [MEAN, *SCENES]
    assert list(panels([run for run in found if run.scene == SCENES[0]])) == [SCENES[0]]


@pytest.mark.parametrize(
    ("cost", "expected"),
    [
        ("seconds", ["fast · ≤500 · 8 it", "fast · ≤1k · 8 it", "paper-7k · 8 it"]),
        ("fps", ["fast · ≤500 · 8 it", "fast · ≤1k · 8 it", "paper-7k · 8 it"]),
        ("memory_bytes", ["fast · ≤500 · 8 it", "fast · ≤1k · 8 it", "paper-7k · 8 it"]),
    ],
)
def test_the_front_in_words(records, cost, expected):
    found = runs(records)
    assert [run.setting for run in best_settings(panels(found)[MEAN], cost, "psnr")] == expected
    sentences = verdict(found, cost, "psnr")
    assert len(sentences) == 3
    assert sentences[0].startswith("Mean over scenes, ")
    assert sentences[1].startswith("fox, ")
    assert all(f": {', '.join(expected)}; dominated: bad · 8 it." in sentence for sentence in sentences)


def test_fields_are_not_compared_by_gaussians(records):
    """A radiance field has a time, and no Gaussians: it is neither on the front of their number nor dominated."""
    field = [r | {"num_gaussians": None} for scene in SCENES for r in training(scene, "plenoxels", None, 500, 20)]
    found = runs(records + field)
    assert "plenoxels" in verdict(found, "seconds", "psnr")[0]
    assert not any("plenoxels" in sentence for sentence in verdict(found, "num_gaussians", "psnr"))


def test_the_table_has_every_figure(records):
    rows = table(runs(records), "seconds")
    assert rows[0] == ["training time: PSNR, SSIM", "mean", "fox", "lego"]
    assert rows[1] == ["paper-7k · 8 it", "100 s: 29.00 / 0.725", "100 s: 28.00 / 0.700", "100 s: 30.00 / 0.750"]
    assert len(rows) == 5
    assert measured_metrics(runs(records)) == ["psnr", "ssim"]


def test_a_scene_may_be_called_mean():
    found = runs(training("mean", "m", None, 10, 20) + training("b", "m", None, 10, 30))
    assert [of_panel[0].last["psnr"] for of_panel in panels(found).values()] == [25, 20, 30]
    assert len(set(table(found, "seconds")[0])) == 4


def test_variants_of_a_scene_have_titles_that_differ():
    scenes = ["fox:downscale=4", "fox:downscale=4:thin=4", "lego:background=white"]
    found = runs([r for scene in scenes for r in training(scene, "m", None, 10, 20)])
    expected = ["fox:downscale=4", "fox:downscale=4:thin=4", "lego"]
    assert table(found, "seconds")[0][1:] == ["mean", *expected]
    assert [sentence.split(",")[0] for sentence in verdict(found, "seconds", "psnr")[1:]] == expected
    drawn = quality_chart(found, "seconds", "psnr").axes
    assert [axes.get_title(loc="left") for axes in drawn] == ["mean of 3 scenes", *expected]


def test_origins(records):
    later = [r | {"date": "2026-11-22T01", "load": 2.0} for r in records]
    (line,) = origins(records + later)
    assert line.startswith("here, 2 compute units, driver 3; clsplat 1, commit abc; 2026-11-21 to 2026-11-22, load")
    assert line.endswith(" 2.0")
    assert "times are not valid" in origins([records[0] | {"load": 2.1}])[0]
    assert len(origins([*records, records[0] | {"commit": "def"}])) == 2
    fewer = origins([*records, records[0] | {"compute_units": 1}])
    assert [line.split(", driver")[0] for line in fewer] == ["here, 2 compute units", "here, 1 compute units"]


def test_short_numbers():
    values = {840: "840", 13589: "13.6k", 40000: "40k", 999.6: "1k", 999_700: "1M", 1.2e6: "1.2M"}
    assert {value: short(value) for value in values} == values


def readable(figure, axes, texts):
    """Whether each text occurs once, no two overlap, and all are within the axes."""
    figure.draw_without_rendering()
    assert sorted(t.get_text() for t in axes.texts) == sorted(texts)
    # The extent of an annotation would include its line.
    found, frame = [Text.get_window_extent(t) for t in axes.texts], axes.get_window_extent()
    for i, a in enumerate(found):
        assert frame.x0 <= a.x0 and a.x1 <= frame.x1 and frame.y0 <= a.y0 and a.y1 <= frame.y1, texts
        assert not any(a.overlaps(b) for b in found[:i]), texts


@pytest.mark.parametrize("cost", COSTS)
def test_every_end_is_labelled_and_can_be_read(records, cost):
    found = runs(records)
    figure = quality_chart(found, cost, "psnr")
    assert len(figure.axes) == 3
    for axes, of_panel in zip(figure.axes, panels(found).values(), strict=True):
        readable(figure, axes, [run.setting for run in of_panel])
        low, high = axes.get_ylim()
        left, right = axes.get_xlim()
        assert all(low < run.last["psnr"] < high and left < run.last[cost] < right for run in of_panel)


def test_labels_of_ends_that_are_close(records):
    found = []
    for k in range(6):
        found += training("a", f"method{k}", None, 100 + k / 2, 28 + k / 50)
    figure = quality_chart(runs(found), "seconds", "ssim")
    readable(figure, figure.axes[0], [f"method{k} · 8 it" for k in range(6)])


def test_less_is_better_points_up():
    found = [r | {"flip": 0.1 + r["psnr"] / 1000} for r in training("a", "m", None, 10, 20)]
    low, high = quality_chart(runs(found), "seconds", "flip").axes[0].get_ylim()
    assert low > high


def test_one_value_everywhere_is_drawn():
    found = training("a", "x", None, 10, 20) + training("a", "y", None, 10, 20)
    figure = quality_chart(runs(found), "num_gaussians", "psnr")
    readable(figure, figure.axes[0], ["x · 8 it", "y · 8 it"])


def test_images_without_error_are_drawn():
    perfect = {"psnr": None, "ssim": 1.0, "flip": 0.0}
    found = runs([r | perfect for name in "xy" for r in training("a", name, None, 10, 20)])
    for metric in measured_metrics(found):
        figure = quality_chart(found, "num_gaussians", metric)
        readable(figure, figure.axes[0], ["x · 8 it", "y · 8 it"])
    assert table(found, "seconds")[1][1] == "10 s: 1.000 / 0.000"


def test_published_figures():
    data = read_published()
    assert list(data["datasets"]) == ["Mip-NeRF360", "Tanks&Temples", "Deep Blending"]
    for methods in data["datasets"].values():
        assert list(methods) == ["Plenoxels", "INGP-Base", "INGP-Big", "M-NeRF360", "3DGS 7K", "3DGS 30K"]
    row = data["datasets"]["Mip-NeRF360"]["3DGS 30K"]
    assert (row["psnr"], row["ssim"], row["train_seconds"]) == (27.21, 0.815, 41 * 60 + 33)
    assert published_table()[-1][1] == "0.815 / 27.21 / 0.214; 42 min, 134, 734 MB"
    figure = published_chart("psnr")
    assert "other hardware" in figure.get_suptitle()
    for axes, methods in zip(figure.axes, data["datasets"].values(), strict=True):
        readable(figure, axes, list(methods))


@pytest.fixture
def empty_charts(monkeypatch):
    """Replace charts by empty ones: other tests check the drawing, which takes seconds."""
    for name in ("quality_chart", "published_chart"):
        monkeypatch.setattr(page, name, lambda *_: Figure(figsize=(1, 1)))


def test_the_page_stands_alone(records, tmp_path, empty_charts):
    page.write_charts(records, tmp_path)
    text = (tmp_path / "index.html").read_text()
    assert not re.findall(r"(?:src|href)=\"(?!data:|#)", text)
    assert "url(" not in text and "@import" not in text
    assert text.count("data:image/svg+xml;base64,") == 2 * (len(COSTS) + 1)
    for expected in (
        "expected 3 photos, found 2",
        "fast · ≤500 · 8 it",
        "other hardware",
        "Mean over scenes",
        "commit a",
    ):
        assert expected in text, expected
    kinds = ("time", "processor-time", "gaussians", "bytes", "memory", "speed", "published")
    drawn = {f"{kind}-{metric}" for kind in kinds for metric in ("psnr", "ssim")}
    files = {f"{name}.{suffix}" for name in drawn for suffix in ("png", "svg")}
    assert {path.name for path in tmp_path.iterdir()} == files | {"index.html"}


def test_a_bench_in_which_all_trainings_failed_has_a_page(tmp_path):
    page.write_charts([record(failed="why <not>")], tmp_path)
    assert "why &lt;not&gt;" in (tmp_path / "index.html").read_text()


def test_names_cannot_break_the_page(tmp_path, empty_charts):
    page.write_charts(training("<b>", "a & $b$ <i>", None, 1, 20), tmp_path)
    text = (tmp_path / "index.html").read_text()
    assert "<b>" not in text and "<i>" not in text
    assert "a &amp; $b$ &lt;i&gt;" in text


def test_there_is_a_chart_for_each_cost():
    assert set(page.NAMES) == set(page.NOTES) == set(COSTS)
    assert set(charts.SHOWN_BELOW) == set(METRICS)
    json.dumps(read_published())
