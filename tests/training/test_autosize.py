"""The size of a scene: the rules in numbers, the search on known Gaussians, the same bits after a resume."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.config import AdcConfig, ErrorConfig, InitConfig, OptimConfig, TrainConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene
from clsplat.training.autosize.explanation import size_chart
from clsplat.training.autosize.reduction import costliest_rows, unvalidated
from clsplat.training.autosize.rule import (
    Candidate,
    Search,
    Trial,
    candidate,
    halvings,
    most_grown,
    most_identifiable,
    next_phase,
    sh_bytes,
    surely_too_few,
    trial_bounds,
    validation_times,
)
from clsplat.training.autosize.validation import can_validate, split
from clsplat.training.loop import train

NOISE = 0.03
"""Standard deviation of the photos' noise: without any, every Gaussian more would pay."""
CONFIG = TrainConfig(
    strategy="adc",
    iterations=3000,
    size="auto",
    init=InitConfig(sh_degree=1),
    adc=AdcConfig(stop_fraction=0.0),
    optim=OptimConfig(means_lr=8e-4, means_lr_final=8e-6),
)


def known_scene(count: int, device: Device, *, copies: int, views: int = 40) -> Scene:
    """Photos, with noise, of Gaussians without view dependence; the points are `copies` of each, displaced."""
    rng = np.random.default_rng(0)
    truth = synthetic_scene(count, seed=4)[0]
    truth.means[:] = rng.uniform(-0.8, 0.8, truth.means.shape)
    truth.log_scales[:] = np.log(rng.uniform(0.06, 0.14, truth.log_scales.shape))
    truth.logit_opacities[:] = rng.uniform(1, 3, count)
    truth.sh[:] = 0
    truth.sh[:, 0] = rng.uniform(-1.2, 1.6, (count, 3))
    photos = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, views, endpoint=False)):
        position = [3 * np.sin(angle), -1.2 + 1.5 * np.sin(3.7 * angle), 3 * np.cos(angle)]
        camera = Camera.look_at(position, [0, 0, 0], [0, -1, 0], 110, 96, 80)
        rgb = render(truth.astype(np.float32), camera, device=device).rgb
        photos.append(View(f"{i:02}.png", camera, to_uint8(rgb + rng.normal(0, NOISE, rgb.shape))))
    points = np.concatenate([truth.means + rng.normal(0, 0.04, truth.means.shape) for _ in range(copies)])
    colors = np.full(points.shape, 128, np.uint8)
    train_views = [view for i, view in enumerate(photos) if i % 5]
    return Scene(train_views, photos[::5], points.astype(np.float64), colors)


def held_out(gaussians: Gaussians, scene: Scene, device: Device) -> float:
    """Mean PSNR of the test photos."""
    return float(
        np.mean([psnr(to_uint8(render(gaussians, v.camera, device=device).rgb), v.image) for v in scene.test])
    )


def test_blocks_of_some_photos_validate() -> None:
    """Every pixel that counts trains or validates, about a quarter of some photos the latter; other photos train
    whole."""
    camera = Camera(np.eye(4), 30, 30, 20, 16, 40, 32)
    left = np.arange(40)[None] < np.full((32, 1), 20)
    masks = {3: left, 5: np.zeros((32, 40), bool)}
    views = [View(f"{i}", camera, np.full((32, 40, 3), i, np.uint8), masks.get(i)) for i in range(34)]
    training, validation = split(views)
    assert [view.name for view in training] == [view.name for view in views]
    held = {view.name: view.mask for view in validation}
    assert len(held) == 12 and {"0", "3", "33"} <= set(held)
    for view, whole in zip(training, views, strict=True):
        if view.name not in held:
            assert view is whole
            continue
        counts = np.ones((32, 40), bool) if whole.mask is None else whole.mask
        assert view.mask is not None and not (view.mask & held[view.name]).any()
        np.testing.assert_array_equal(view.mask | held[view.name], counts)
        assert 0.2 < held[view.name].sum() / counts.sum() < 0.3
    assert np.all(sum(mask.astype(int) for mask in held.values()) <= 4), "no place of all photos is missing"
    alone = split([views[0], views[5]])
    assert [view.name for view in alone[1]] == ["0"], "a photo without a pixel that counts cannot validate"
    assert can_validate(views[:8]) and not can_validate(views[:7])


@pytest.mark.parametrize(("larger", "pays"), [(30.04, True), (30.06, False)])
def test_half_the_gaussians_pay_if_they_lose_less_than_half_a_price(larger: float, pays: bool) -> None:
    """At 0.1 dB per doubling a loss of 0.05 dB pays for 1 / sqrt(2) of the Gaussians."""
    config = replace(CONFIG, size_price=0.1)
    smaller = candidate(1, 362, 3, [[30.0, 31.0, 35.0]], config)
    photos = np.array([30.0, 31.0, 35.0]) + larger - 30 + 0.03 * np.array([-1, 0, 1])
    trial = Trial(False, smaller, candidate(1, 512, 3, [photos.tolist()], config))
    assert trial.gain == pytest.approx(larger - 30) and trial.price == pytest.approx(0.05, rel=1e-3)
    assert trial.takes_smaller == pays


def test_the_photos_in_the_middle_tell_the_gain() -> None:
    """Of twelve the three luckiest and the three unluckiest do not; the error is a trimmed mean's (Tukey and
    McLaughlin 1963): that of the winsorised differences, over the half that counts."""
    differences = np.array([9.0, 0.5, 0.3, 0.1, 0.2, 0.0, -0.1, -0.2, 0.05, -0.3, -0.6, -7.0])
    views = np.linspace(25, 30, 12)
    sides = (candidate(1, n, 3, [v.tolist()], CONFIG) for n, v in ((100, views), (141, views + differences)))
    trial = Trial(False, *sides)
    assert trial.gain == pytest.approx(np.mean([0.1, 0.2, 0.0, -0.1, -0.2, 0.05]))
    winsorised = np.clip(differences, -0.2, 0.2)
    assert trial.standard_error == pytest.approx(winsorised.std(ddof=1) / (0.5 * np.sqrt(12)))


def test_growth_goes_on_unless_it_surely_hurts() -> None:
    """Whatever its price. Photo by photo the larger side is worse by 0.1 dB on the mean, with a standard error of
    0.03 or 0.1 dB."""
    smaller = [30.0, 31.0, 25.0]
    for errors, hurts in (((-0.15, -0.10, -0.05), True), ((-0.27, -0.10, 0.07), False), ((0.03, 0.01, 0.02), False)):
        sides = (
            candidate(1, n, 3, [views], CONFIG) for n, views in ((100, smaller), (200, list(np.add(smaller, errors))))
        )
        trial = Trial(True, *sides)
        assert trial.takes_smaller == hurts, errors
        assert trial.gain < trial.price
    same = candidate(1, 100, 3, [smaller], CONFIG)
    assert Trial(True, same, same).takes_smaller, "nothing has grown"


def test_growth_that_pays_many_times_needs_no_trial() -> None:
    """One that gains g per doubling grows by sqrt(g / price) before the next: half the doublings to the price, if
    each gains half of the one before."""

    def grown(gain: float) -> list[Trial]:
        """By a factor of sqrt(2)."""
        sides = (candidate(1, n, 3, [[psnr, psnr]], CONFIG) for n, psnr in ((1000, 30.0), (1414, 30 + gain / 2)))
        return [Trial(True, *sides)]

    assert surely_too_few([], 0.1) == 0
    assert surely_too_few(grown(1.6), 0.1) == pytest.approx(4 * 1414, rel=1e-3)
    assert surely_too_few(grown(0.1001), 0.1) == pytest.approx(1414, rel=1e-2)
    assert surely_too_few(grown(0.09), 0.1) == surely_too_few(grown(-3.0), 0.1) == 0, "at once"
    config = replace(CONFIG, iterations=2000, size_price=0.1)
    for most, todo in ((5500, "grow"), (5700, "try")):
        assert next_phase(Search(most, grown(1.6)), 600, config, 10**6) == todo
    same = candidate(1, 100, 3, [[30.0, 31.0]], CONFIG)
    assert surely_too_few([Trial(True, same, same)], 0.1) == 0, "nothing has grown"


def test_windows_of_growth_end_where_the_next_trial_is_due() -> None:
    """By sqrt(2) in a trial, by 2 without one, but no further than growth surely pays, or the bound."""
    sides = (candidate(1, n, 3, [[psnr, psnr]], CONFIG) for n, psnr in ((1000, 30.0), (1414, 30.8)))
    grown = [Trial(True, *sides)]
    config = replace(CONFIG, size_price=0.1)
    for most, todo, expected in (
        (1414, "try", 2000),
        (1414, "grow", 2828),
        (4000, "grow", 5657),
        (4000, "rest", 4000),
        (4000, "prune", 4000),
    ):
        assert most_grown(Search(most, grown), todo, config, 10**6) == pytest.approx(expected, rel=1e-3), todo
    for todo in ("try", "grow"):
        assert most_grown(Search(1414, grown), todo, config, 1500) == 1500
    short = replace(config, iterations=1500)  # a round in 100 iterations, windows of 75
    assert most_grown(Search(1414, grown), "try", short, 10**6) == pytest.approx(2828, rel=1e-3)


def trials_of(grows: bool, *takes_smaller: bool) -> list[Trial]:
    return [
        Trial(
            grows,
            Candidate(1, 100, 0, 30.0, [30.0, 31.0], 0.0),
            Candidate(1, 200, 0, psnr, [psnr, psnr + 1], 0.5 - won),
        )
        for won in takes_smaller
        for psnr in [29.0 if won else 31.0]
    ]


def test_trials_follow_each_other() -> None:
    """Growth until it is late, whatever was lost; then pruning, until there is little to gain."""
    config = replace(CONFIG, iterations=2000)
    for lost, todo in (
        ([], "try"),
        ([False, False], "grow"),
        ([False, True], "try"),
        ([True, False, True], "try"),
        ([False, True, True], "try"),
    ):
        assert next_phase(Search(100, trials_of(True, *lost)), 600, config, 1000) == todo, lost
    assert next_phase(Search(100), 1000, config, 1000) == "rest", "in the middle of the run"
    assert next_phase(Search(100), 200, config, 100) == "rest", "at the cap"
    # What growth came to does not matter to pruning.
    grown = trials_of(True, False, False)
    cases: tuple[tuple[list[bool], int, str], ...] = (
        ([], 1200, "prune"),
        ([True], 1300, "prune"),
        ([True, False], 1400, "prune"),
        ([False, False], 1400, "prune"),
        ([False, False, False], 1500, "settle"),
        ([True] * 5, 1700, "settle"),
    )
    for pruned, iteration, todo in cases:
        assert next_phase(Search(100, [*grown, *trials_of(False, *pruned)]), iteration, config, 1000) == todo, pruned


def test_steps_of_pruning_grow_while_they_pay() -> None:
    """As halvings: growth has no say; what is taken doubles the next step, what is lost halves it."""
    grown = trials_of(True, False, True)
    for taken, step in (
        ([], 0.5),
        ([True], 1.0),
        ([True, True], 2.0),
        ([True, False], 0.5),
        ([False], 0.25),
        ([False, True], 0.5),
    ):
        assert halvings([*grown, *trials_of(False, *taken)]) == step, taken


def test_parameters_are_no_more_than_values() -> None:
    """By hand: 2 photos of 40x30 pixels, of which one shows its left half only, have 3 * 1800 values; a Gaussian of
    degree 0 has 14 parameters."""
    camera = Camera(np.eye(4), 30, 30, 20, 15, 40, 30)
    half = np.arange(40)[None] < np.full((30, 1), 20)
    views = [View(str(mask is None), camera, np.zeros((30, 40, 3), np.uint8), mask) for mask in (None, half)]
    config = replace(CONFIG, init=InitConfig(sh_degree=0))
    assert most_identifiable(views, config) == 3 * 1800 // 14
    assert most_identifiable(views, replace(config, max_gaussians=7)) == 7


def test_worth_counts_doublings_of_bytes() -> None:
    config = replace(CONFIG, size_price=0.25)
    assert [sh_bytes(d) for d in range(4)] == [56, 92, 152, 236]
    small, large = (
        candidate(1, 64, 0, [[20.0, 21.0], [20.0, 23.0]], config),
        candidate(1, 128, 3, [[20.0, 22.0]], config),
    )
    assert small.views == large.views == [20, 22], "the mean of all looks, photo by photo"
    assert small.psnr == 21 and small.worth == pytest.approx(21 - 0.25 * np.log2(64 * 56))
    assert small.worth - large.worth == pytest.approx(0.25 * (1 + np.log2(236 / 56)))


def test_stops_are_within_the_run() -> None:
    assert trial_bounds(replace(CONFIG, iterations=2000)) == [*range(200, 1001, 200), *range(1200, 1701, 100)]
    assert trial_bounds(replace(CONFIG, iterations=7000))[:3] == [700, 1400, 2100]
    found = sorted(validation_times(replace(CONFIG, iterations=2000)))
    assert found[:4] == [350, 400, 550, 600] and found[-1] == 1700
    for iterations in (1, 2, 3, 10, 19):
        found = trial_bounds(replace(CONFIG, iterations=iterations))
        assert found and 1 <= found[0] and found[-1] <= iterations


def test_a_run_settles_and_explains(device: Device, tmp_path: Path) -> None:
    """Cap and decisions hold in a short run; interrupted between two trials or within one, it ends with the same
    bits."""
    scene = known_scene(20, device, copies=4, views=24)
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    # A price at which the start is not the best.
    config = replace(CONFIG, iterations=200, checkpoint_every=1000, size_price=8.0)
    sizes: list[int] = []
    whole = train(scene, config, tmp_path / "whole", device, progress=lambda r: sizes.append(r["num_gaussians"]))
    report = json.loads((tmp_path / "whole" / "size.json").read_text())
    trials = report["trials"]
    assert [trial["n"] for trial in trials][:2] == [[56, 80], [28, 56]] and max(sizes) == 80
    for trial in trials:
        assert (trial["taken"] == trial["n"][0]) == (trial["gain"] <= trial["price"]), trial
        assert trial["price"] == pytest.approx(8 * np.log2(trial["n"][1] / trial["n"][0]))
    # Each begins with what the one before it came to.
    assert all(b["n"][1] == a["taken"] for a, b in pairwise(trials))
    assert report["chosen"]["n"] == trials[-1]["taken"] == len(whole) == sizes[-1]
    degrees = report["degrees"]
    assert report["chosen"]["sh_degree"] == max(degrees, key=lambda p: p["worth"])["sh_degree"] == whole.sh_degree
    size_chart(tmp_path / "whole" / "size.json", tmp_path / "size.png")
    assert (tmp_path / "size.png").read_bytes().startswith(b"\x89PNG")

    # A trial tells of the iteration before it, once for each of its own.
    for iteration, told in ((132, 1), (139, 4)):
        calls: list[int] = []

        def interrupt(
            record: dict[str, Any], at: int = iteration, after: int = told, calls: list[int] = calls
        ) -> None:
            calls.append(record["iteration"])
            if calls.count(at) == after:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            train(scene, config, tmp_path / "parts", device, resume=iteration > 132, progress=interrupt)
    resumed = train(scene, config, tmp_path / "parts", device, resume=True)
    assert len(resumed) == len(whole)
    for name, array in whole.arrays().items():
        assert resumed.arrays()[name].tobytes() == array.tobytes(), name
    assert (tmp_path / "parts" / "size.json").read_text() == (tmp_path / "whole" / "size.json").read_text()


def test_a_step_leaves_what_the_photos_would_miss(device: Device) -> None:
    """Of twenty visible Gaussians and eight that are all but transparent, the transparent ones go."""
    scene = known_scene(20, device, copies=1, views=8)
    gaussians = synthetic_scene(28, 4)[0].astype(np.float32)
    gaussians.means[:20] = scene.points
    gaussians.logit_opacities[:] = 2
    gaussians.logit_opacities[20:] = -5
    rows = costliest_rows(gaussians, 0.7, scene.train, Renderer(device))
    assert len(rows) == 19 and set(rows) <= set(range(20))


def test_blocks_that_validate_have_no_say_in_prices(device: Device) -> None:
    """They show what is rendered, and the rest what the photos show."""
    scene = known_scene(5, device, copies=1, views=20)
    gaussians = synthetic_scene(9, 4)[0].astype(np.float32)
    training, _ = split(scene.train)
    shown = unvalidated(gaussians, scene.train, Renderer(device))
    assert [view.name for view in shown] == [view.name for view in scene.train]
    for part, view, whole in zip(training, shown, scene.train, strict=True):
        if part is whole:
            assert view is whole
            continue
        assert part.mask is not None and view.mask is None
        np.testing.assert_array_equal(view.image[part.mask], whole.image[part.mask])
        drawn = to_uint8(render(gaussians, view.camera, device=device).rgb)
        np.testing.assert_array_equal(view.image[~part.mask], drawn[~part.mask])


@pytest.mark.parametrize(("photos", "pricing"), [(8, 8), (24, 24), (25, 13), (100, 20), (300, 60)])
def test_a_fifth_of_many_photos_says_what_gaussians_are_worth(photos: int, pricing: int, device: Device) -> None:
    gaussians = synthetic_scene(9, 4)[0].astype(np.float32)
    camera = Camera.look_at((0, 0, -5), (0, 0, 0), (0, 1, 0), 20, 16, 16)
    view = View("photo", camera, np.zeros((16, 16, 3), np.uint8))
    assert len(unvalidated(gaussians, [view] * photos, Renderer(device))) == pricing


def test_flat_walls_need_little(device: Device, tmp_path: Path) -> None:
    """Grey all around: what is off by less than a level in 255 is not improved. Measured: 55 Gaussians of 200, all
    photos above 50 dB; 77 where errors below a level count."""
    scene = known_scene(20, device, copies=10)
    walls = [replace(view, image=np.full_like(view.image, 128)) for view in (*scene.train, *scene.test)]
    scene = replace(scene, train=walls[::2], test=walls[1::2])
    gaussians = train(scene, TrainConfig(iterations=600), tmp_path, device)
    assert len(gaussians) < 70 and held_out(gaussians, scene, device) > 48
    trials = json.loads((tmp_path / "size.json").read_text())["trials"]
    assert max(max(trial["psnr"]) for trial in trials) <= 20 * np.log10(255)


def test_too_few_photos_to_validate(device: Device, tmp_path: Path) -> None:
    """The size is not sought, and no strategy adds Gaussians."""
    scene = known_scene(5, device, copies=1, views=8)
    error = ErrorConfig(start=1, every=1)
    config = replace(CONFIG, iterations=20, strategy="error", error=error)
    assert len(scene.train) == 6
    gaussians = train(scene, config, tmp_path, device)
    assert len(gaussians) <= 5 and not (tmp_path / "size.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("count", "plateau", "best"), [(64, 128, 31.64), (128, 256, 31.12), (256, 512, 30.62)])
def test_it_finds_the_size_of_known_scenes(
    device: Device, tmp_path: Path, count: int, plateau: int, best: float
) -> None:
    """From eight times as many Gaussians as the photos show, a size within 1.5 of the smallest that reaches the
    plateau, at its quality within 0.2 dB.

    `plateau`, `best`: of fixed sizes, factors of sqrt(2) apart, the smallest within 0.2 dB of the best and that one's
    quality (tests/training/measure_known.py). Measured: 127, 255 and 511 Gaussians, 31.6, 31.0 and 30.4 dB.
    """
    scene = known_scene(count, device, copies=8)
    gaussians = train(scene, CONFIG, tmp_path, device)
    assert plateau / 1.5 <= len(gaussians) <= 1.5 * plateau
    assert held_out(gaussians, scene, device) > best - 0.2
