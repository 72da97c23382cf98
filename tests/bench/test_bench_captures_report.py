"""Report of `clsplat bench captures`: noise over seeds, means by kind of capture, and the choice by rotation."""

import numpy as np
import pytest
from test_bench_charts import record

from clsplat.bench.captures import STANDARD
from clsplat.bench.captures_report import (
    QUANTITIES,
    Figure,
    Results,
    details,
    figures,
    kinds,
    rotation,
    rotation_text,
    scenes_of,
    summary,
    verdict,
)
from clsplat.bench.cells import standard_variants
from clsplat.bench.quality_summary import runs, trainings
from clsplat.errors import InputError


def training(scene, method, psnr, seed=0, **figures):
    """The last record of a training, which fell by 1 dB."""
    values = {"seed": seed, "iteration": 8, "psnr": psnr, "best": psnr + 1, "train_psnr": psnr + 2, "worst": psnr - 3}
    values |= {
        "ssim": psnr / 40,
        "flip": None,
        "rare_psnr": None,
        "num_gaussians": 1000,
        "cpu_seconds": 10,
        "fps": 9.0,
    }
    return [record(scene, method, **{**values, **figures})]


M, N = "m · 8 it", "n · 8 it"


def tables(text):
    """Cells of each Markdown table of a text, with its header."""
    found, lines = [], [*text.split("\n"), ""]
    rows = []
    for line in lines:
        if line.startswith("|---"):
            continue
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("|").split("|")])
        elif rows:
            found.append(rows)
            rows = []
    return found


def test_figures_of_a_training():
    (run,) = trainings(training("a", "m", 20, best=20.5, rare_psnr=15.0))
    found = figures(run)
    assert found["drop"] == -0.5 and found["gap"] == 2
    assert (found["worst"], found["rare_psnr"], found["flip"], found["cpu_seconds"]) == (17, 15, None, 10)
    (run,) = trainings(training("a", "m", 20, best=20, train_psnr=None))
    assert figures(run)["drop"] == 0 and figures(run)["gap"] is None


def test_seeds_are_averaged_for_charts():
    found = [*training("a", "m", 20), *training("a", "m", 23, seed=1), *training("a", "n", 9)]
    found += [r | {"iteration": 4, "psnr": r["psnr"] + 1} for r in found]
    assert [run.seed for run in trainings(found)] == [0, 1, 0]
    mean, single = runs(found)
    assert [sample["psnr"] for sample in mean.samples] == [22.5, 21.5]
    assert (mean.seed, single.seed) == (None, 0)
    assert single.last["psnr"] == 9


def test_noise_is_the_standard_error_over_seeds():
    rng = np.random.default_rng(0)
    psnr = {method: 20 + rng.normal(size=3) for method in ("m", "n")}
    found = [r for method, values in psnr.items() for s, v in enumerate(values) for r in training("a", method, v, s)]
    results = Results(found)
    # Both methods tell about the noise of the capture.
    variance = np.mean([np.var(values, ddof=1) for values in psnr.values()])
    assert results.variance("a", "psnr") == pytest.approx(variance)
    figure = results.mean(["a"], M, "psnr")
    assert figure.value == pytest.approx(psnr["m"].mean())
    assert figure.error == pytest.approx(np.sqrt(variance / 3))
    # A capture with one seed has the noise of the others.
    results = Results(found + training("b", "m", 30) + training("b", "n", 31))
    assert results.mean(["b"], M, "psnr").error == pytest.approx(np.sqrt(variance))
    figure = results.mean(["a", "b"], M, "psnr")
    assert figure.value == pytest.approx((psnr["m"].mean() + 30) / 2)
    assert figure.error == pytest.approx(np.sqrt(variance / 3 + variance) / 2)
    assert Results(training("a", "m", 20)).mean(["a"], M, "psnr") == Figure(20, None)


def test_the_noise_of_the_noise_is_right():
    """Two methods that are equal differ by more than two standard errors in about one of 20 cases."""
    rng = np.random.default_rng(1)
    wins = 0
    for _ in range(300):
        found = [
            r
            for capture in ("a", "b:thin=2", "c")
            for method in ("m", "n")
            for seed in range(3)
            for r in training(capture, method, 20 + rng.normal(), seed)
        ]
        results = Results(found)
        means = [results.mean(results.common, method, "psnr") for method in (M, N)]
        wins += means[0].minus(means[1]).result != "tie"
    assert 0.02 * 300 < wins < 0.12 * 300


def test_errors_of_counts_are_whole_numbers():
    """45.8k ± 0.333 would read as 333 Gaussians."""
    assert Figure(45_772, 0.333).text(QUANTITIES["num_gaussians"]) == "45.8k ± 0"


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [(0.3, 0.1, "win"), (0.2, 0.1, "tie"), (-0.2, 0.1, "tie"), (-0.3, 0.1, "loss"), (9.0, None, "noise unknown")],
)
def test_differences_below_the_noise_are_ties(value, error, expected):
    assert Figure(value, error).result == expected
    assert Figure(1 + value, error).minus(Figure(1, None if error is None else 0.0)).result == expected


def test_captures_by_kind_and_by_scene():
    captures = [f"{scene}{capture.options}" for scene in ("a", "b:downscale=2") for capture in STANDARD]
    assert {kind: len(found) for kind, found in kinds(captures).items()} == {
        "full": 2,
        "thinned": 6,
        "arc": 2,
        "fewer points": 2,
    }
    assert scenes_of([*captures, "a:downscale=4"]) == {"a": [*captures[:6], "a:downscale=4"], "b": captures[6:]}


def test_standard_variants():
    assert standard_variants("x/a:downscale=4") == [
        f"x/a:downscale=4{option}" for option in ("", ":thin=2", ":thin=4", ":thin=8", ":arc=0.2", ":points=0.1")
    ]
    with pytest.raises(InputError, match="a:thin=2: expected no options for a variant"):
        standard_variants("a:thin=2")


def seeded(psnr, noise=0.01):
    """Records of trainings with two seeds; psnr is by capture and method."""
    found = []
    for capture, of_capture in psnr.items():
        for method, value in of_capture.items():
            found += training(capture, method, value - noise) + training(capture, method, value + noise, seed=1)
    return found


SCORES = {
    "a": {"m": 30, "n": 31},
    "a:thin=2": {"m": 27, "n": 25},
    "b": {"m": 20, "n": 20},
    "c": {"m": 25, "n": 22},
}


def test_means_are_over_the_captures_that_all_methods_finished():
    results = Results(seeded({**SCORES, "d": {"m": 99}}))
    assert results.common == list(SCORES)
    assert results.captures == [*SCORES, "d"]
    text = summary(seeded({**SCORES, "d": {"m": 99}}))
    assert "have finished on them: d." in text
    full, thinned, turns = tables(text)
    names = [name for name in QUANTITIES if name not in ("flip", "rare_psnr")]  # these were not measured
    psnr = 1 + names.index("psnr")
    error = 0.01 * np.sqrt(2) / np.sqrt(2)
    assert full[1][:2] == [M, f"25.00 ± {error / np.sqrt(3):.2f}"]
    assert [row[psnr] for row in thinned[1:]] == ["27.00 ± 0.01", "25.00 ± 0.01"]
    assert full[0][psnr] == "PSNR, dB" and len(full[0]) == 1 + len(names)
    assert len(turns) == 1 + 3
    assert "99.00" not in text and "99.00 ± 0.01" in details(seeded({**SCORES, "d": {"m": 99}}))


def test_the_other_scenes_choose():
    # On b and c m leads by (0 + 3)/2; on a, the mean over its captures, by (-1 + 2)/2.
    turns = rotation(Results(seeded(SCORES)))
    assert [(t.scene, t.chosen, t.rival) for t in turns] == [(s, M, N) for s in "abc"]
    assert [t.margin.value for t in turns] == pytest.approx([1.5, 1.75, 0.25])
    assert [t.difference.value for t in turns] == pytest.approx([0.5, 0, 3])
    assert [t.score.value for t in turns] == pytest.approx([28.5, 20, 25])
    assert [t.difference.result for t in turns] == ["win", "tie", "win"]
    assert turns[0].difference.error == pytest.approx(0.01)
    assert verdict(turns) == (
        "m · 8 it is chosen whichever scene is left out, but does not win on each of them: win on a, c; tie on b."
    )


def test_a_method_is_good_if_it_wins_on_every_scene_left_out():
    scores = {**SCORES, "b": {"m": 21, "n": 20}}
    assert verdict(rotation(Results(seeded(scores)))).startswith("m · 8 it is good")
    assert "tie on a, b; win on c" in verdict(rotation(Results(seeded(scores, noise=0.6)))), "1 dB is below the noise"
    scores |= {"b": {"m": 19.9, "n": 20}}
    assert "loss on b" in verdict(rotation(Results(seeded(scores))))
    once = [r for r in seeded(scores) if r["seed"] == 0]
    assert verdict(rotation(Results(once))).startswith("No claim is made: the noise is unknown.")
    # Without c, the others choose n.
    scores = {"a": {"m": 20, "n": 21}, "b": {"m": 20, "n": 21}, "c": {"m": 25, "n": 20}}
    assert verdict(rotation(Results(seeded(scores)))).startswith("No method is good")


def test_a_choice_needs_two_scenes_and_two_methods():
    text = "A choice by rotation requires two scenes and two methods."
    assert rotation_text(Results(seeded({"a": SCORES["a"], "a:thin=2": SCORES["a:thin=2"]}))) == text
    assert rotation_text(Results(seeded({"a": {"m": 1}, "b": {"m": 1}}))) == text


def test_rare_pixels_count_where_they_are_known():
    found = training("a", "m", 20, rare_psnr=10.0) + training("b", "m", 30)
    results = Results(found)
    assert results.mean(["a", "b"], M, "rare_psnr") == Figure(10, None)
    assert results.mean(["b"], M, "rare_psnr") is None
    rows = tables(details(found))[0]
    column = rows[0].index("rare pixels, dB")
    assert [row[column] for row in rows[1:]] == ["10.00", ""]


def test_fields_have_rows_without_gaussians():
    found = training("a", "m", 20) + training("a", "ingp-base", 21, num_gaussians=None)
    (rows,) = tables(details(found))
    assert [row[1] for row in rows[1:]] == [M, "ingp-base · 8 it"]
    assert [row[rows[0].index("Gaussians")] for row in rows[1:]] == ["1k", ""]


def test_each_reason_of_a_failure_is_told_once():
    failed = [record("a:thin=8", method, failed="too few") for method in ("m", "n")]
    text = summary(seeded(SCORES) + failed)
    assert text.endswith("Without a result:\n\n* a:thin=8: too few")
    assert summary(failed).startswith("A choice by rotation requires")
