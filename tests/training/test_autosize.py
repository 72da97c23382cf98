"""The size of a scene: quality, the search on known Gaussians, the same bits after a resume."""

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import AdcConfig, CoarseConfig, ErrorConfig, InitConfig, OptimConfig, TrainConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, ssim, to_uint8
from clsplat.render import render
from clsplat.renderer import Renderer, download
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene
from clsplat.training.autosize.explanation import size_chart, write_report
from clsplat.training.autosize.reduction import costliest_rows, unvalidated
from clsplat.training.autosize.rule import (
    CHEAPEST,
    TRIAL_RATES,
    Search,
    candidate,
    first_pruning,
    growth_bounds,
    most_grown,
    start,
)
from clsplat.training.autosize.validation import PERFECT, can_validate, decibels, split, validate
from clsplat.training.loop import train
from clsplat.training.optimizer import adam_settings
from clsplat.training.session import Training
from clsplat.training.state import initial_state

NOISE = 0.03
"""Standard deviation of the photos' noise: without any, every Gaussian more would pay."""
CONFIG = TrainConfig(
    strategy="adc",
    iterations=3000,
    size="auto",
    init=InitConfig(sh_degree=1, dense=False),
    adc=AdcConfig(stop_fraction=0.0),
    optim=OptimConfig(means_lr=8e-4, means_lr_final=8e-6),
)
GROWING = replace(CONFIG, strategy="error")
"""With a strategy that adds Gaussians. Pruning is tried where more of them were worse."""


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


def photo(name: str, value: int = 0, mask: NDArray[np.bool_] | None = None) -> View:
    camera = Camera.look_at((0, 0, -5), (0, 0, 0), (0, 1, 0), 20, 16, 16)
    return View(name, camera, np.full((16, 16, 3), value, np.uint8), mask)


@pytest.mark.parametrize(
    ("count", "held"), [(8, [0, 4]), (12, [0, 6]), (22, [0, 7, 14]), (26, [0, 6, 13, 19]), (300, None)]
)
def test_some_photos_are_held_back(count: int, held: list[int] | None) -> None:
    """Every photo trains or validates; the latter are evenly spaced and begin with the first."""
    views = [photo(f"{i:03}") for i in range(count)]
    training, validation = split(views)
    assert sorted(v.name for v in (*training, *validation)) == [v.name for v in views]
    names = [int(v.name) for v in validation]
    assert names == held if held else len(names) == 16 and names[0] == 0
    assert np.ptp(np.diff([*names, count])) <= 1
    assert can_validate(views) and not can_validate(views[:7])


def test_photos_without_a_pixel_that_counts_are_not_held_back() -> None:
    nothing = np.zeros((16, 16), bool)
    views = [photo(f"{i}", mask=nothing if i < 3 else None) for i in range(12)]
    assert [view.name for view in split(views)[1]] == ["3", "7"]
    assert not can_validate([photo(f"{i}", mask=nothing if i else None) for i in range(12)])


def test_quality_is_the_mean_of_two_measures(device: Device) -> None:
    """PSNR and SSIM of pixels that count, in decibels; after a fit of the colours, another exposure is no error."""
    scene = known_scene(20, device, copies=1, views=10)
    gaussians, view = synthetic_scene(9, 4)[0].astype(np.float32), scene.train[0]
    renderer = Renderer(device)
    image = to_uint8(render(gaussians, view.camera, device=device).rgb)
    (found,) = validate(gaussians, [view], renderer, 3)
    expected = (psnr(image, view.image) - 10 * np.log10(1 - ssim(image, view.image))) / 2
    assert found == pytest.approx(expected, abs=1e-3)
    (own,) = validate(gaussians, [replace(view, image=image)], renderer, 3)
    assert 40 < own <= PERFECT, "the photo is rounded, and the render is not"
    darker = replace(view, image=to_uint8(0.7 * image / 255 + 0.1))
    plain, fitted = (validate(gaussians, [darker], renderer, 3, fitted=f)[0] for f in (False, True))
    assert plain < 30 and fitted > 35
    mask = np.zeros(image.shape[:2], bool)
    mask[:, : image.shape[1] // 2] = True
    spoilt = np.where(mask[:, :, None], view.image, 255 - view.image)  # no pixel that counts
    (half,) = validate(gaussians, [replace(view, image=spoilt, mask=mask)], renderer, 3)
    assert half == pytest.approx(
        (psnr(image, view.image, mask) - 10 * np.log10(1 - ssim(image, view.image, mask))) / 2, abs=0.3
    ), "SSIM of the training loss sees black beyond the mask"


def test_growth_has_a_pace(device: Device) -> None:
    """To three times the first Gaussians within two fifths of the run, or to one per pixel of a small photo."""
    scene = known_scene(20, device, copies=1, views=10)
    growing = len(growth_bounds(CONFIG)) - 1  # the first window has the first Gaussians
    assert growing == 3
    search = start(scene, 1000, CONFIG)
    assert search.most == 1000 and search.pace**growing == pytest.approx(96 * 80 / 1000)
    many = replace(scene, points=np.zeros((5000, 3)))
    assert start(many, 5000, CONFIG).pace ** growing == pytest.approx(3)
    camera = Camera.look_at((0, 0, -5), (0, 0, 0), (0, 1, 0), 900, 900, 400)
    large = replace(scene, train=[View("large", camera, np.zeros((400, 900, 3), np.uint8))])
    assert start(large, 1000, CONFIG).pace ** growing == pytest.approx(90 * 2**0.5), "the root of edges twice as long"
    for price, factor in ((0.025, 2), (0.0, CHEAPEST), (0.1, 1)):
        priced = replace(CONFIG, size_price=price)
        assert start(large, 1000, priced).pace ** growing == pytest.approx(90 * 2**0.5 * factor)
        assert start(many, 5000, priced).pace ** growing == pytest.approx(3 * factor)
    assert most_grown(search, CONFIG) == np.ceil(1000 * search.pace)
    assert most_grown(search, replace(CONFIG, max_gaussians=1100)) == 1100
    assert most_grown(replace(search, grows=False), CONFIG) == 1000


def test_the_report_has_the_size_before_and_after_all_photos_train(tmp_path: Path) -> None:
    search = Search(40, degrees=[candidate(9, 30, 0, [[20.0, 21.0]], CONFIG)])
    write_report(tmp_path / "size.json", search, 40, CONFIG, [])
    chosen = json.loads((tmp_path / "size.json").read_text())["chosen"]
    assert chosen == {"n": 30, "n_with_all_photos": 40, "sh_degree": 0}


def test_a_run_settles_and_explains(device: Device, tmp_path: Path) -> None:
    """Cap and decisions hold in a short run; interrupted between two trials or within one, it ends with the same
    bits."""
    scene = known_scene(20, device, copies=4, views=36)
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    # A price at which the start is not the best.
    init = replace(GROWING.init, sky=False)  # nothing is removed before the plain background
    config = replace(GROWING, iterations=200, checkpoint_every=1000, size_price=8.0, init=init)
    sizes: list[int] = []
    whole = train(scene, config, tmp_path / "whole", device, progress=lambda r: sizes.append(r["num_gaussians"]))
    report = json.loads((tmp_path / "whole" / "size.json").read_text())
    # 8 dB less is an error of 0.16, as of a part of each of log2(N) doublings.
    assert report["least_share"] == pytest.approx(np.log2(10 ** (config.size_price / 10)))
    trials = report["trials"]
    assert [found["n"] for found in trials] == [[80, 320], [40, 80], [20, 40], [10, 20]]
    for found in trials:
        assert (found["taken"] == found["n"][0]) == (found["gain"] <= found["price"] + found["margin"]), found
        assert found["price"] == pytest.approx(8 * np.log2(found["n"][1] / found["n"][0]))
    # Each begins with what the one before it came to.
    assert all(a["taken"] in b["n"] for a, b in pairwise(trials))
    assert report["chosen"]["n"] == trials[-1]["taken"] == len(whole) == sizes[-1] < len(scene.points)
    assert report["held_back"] == [view.name for view in split(scene.train)[1]]
    degrees = report["degrees"]
    assert report["chosen"]["sh_degree"] == max(degrees, key=lambda p: p["worth"])["sh_degree"] == whole.sh_degree
    size_chart(tmp_path / "whole" / "size.json", tmp_path / "size.png")
    assert (tmp_path / "size.png").read_bytes().startswith(b"\x89PNG")

    # A trial tells of the iteration before it, once for each of its own.
    for iteration, told in ((82, 1), (89, 4)):
        calls: list[int] = []

        def interrupt(
            record: dict[str, Any], at: int = iteration, after: int = told, calls: list[int] = calls
        ) -> None:
            calls.append(record["iteration"])
            if calls.count(at) == after:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            train(scene, config, tmp_path / "parts", device, resume=iteration > 82, progress=interrupt)
    resumed = train(scene, config, tmp_path / "parts", device, resume=True)
    assert len(resumed) == len(whole)
    for name, array in whole.arrays().items():
        assert resumed.arrays()[name].tobytes() == array.tobytes(), name
    assert (tmp_path / "parts" / "size.json").read_text() == (tmp_path / "whole" / "size.json").read_text()
    logs = [(tmp_path / name / "log.jsonl").read_text() for name in ("parts", "whole")]
    logs = [re.sub(r'"seconds": [0-9.e-]+', "", log) for log in logs]
    assert logs[0] == logs[1] and logs[0].count("loss") == 20


def test_trials_of_pruning_train_with_low_rates(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    factors: dict[int, set[float]] = {}

    def spied(iteration: int, *args: Any) -> Any:
        factors.setdefault(iteration, set()).add(args[-1])
        return adam_settings(iteration, *args)

    monkeypatch.setattr("clsplat.training.session.adam_settings", spied)
    config = replace(GROWING, iterations=200, size_price=8.0)
    train(known_scene(20, device, copies=4, views=36), config, tmp_path, device)
    first = first_pruning(config)
    assert [factors[iteration] for iteration in (first - 1, first, 200)] == [{1.0}, {TRIAL_RATES}, {1.0}]


def test_a_step_leaves_what_the_photos_would_miss(device: Device) -> None:
    """Of twenty visible Gaussians and eight that are all but transparent, the transparent ones go."""
    scene = known_scene(20, device, copies=1, views=8)
    gaussians = synthetic_scene(28, 4)[0].astype(np.float32)
    gaussians.means[:20] = scene.points
    gaussians.logit_opacities[:] = 2
    gaussians.logit_opacities[20:] = -5
    rows = costliest_rows(gaussians, 0.7, scene.train, Renderer(device))
    assert len(rows) == 19 and set(rows) <= set(range(20))


def test_photos_that_are_held_back_have_no_say_in_prices(device: Device) -> None:
    """They show what is rendered, and the others what the photos show."""
    scene = known_scene(5, device, copies=1, views=20)
    gaussians = synthetic_scene(9, 4)[0].astype(np.float32)
    held = split(scene.train)[1]
    shown = unvalidated(gaussians, scene.train, Renderer(device))
    assert [view.name for view in shown] == [view.name for view in scene.train]
    for view, given in zip(shown, scene.train, strict=True):
        if given in held:
            drawn = to_uint8(render(gaussians, given.camera, device=device).rgb)
            np.testing.assert_array_equal(view.image, drawn)
        else:
            assert view is given


@pytest.mark.parametrize(("photos", "pricing"), [(8, 8), (24, 24), (25, 13), (100, 20), (300, 60)])
def test_a_fifth_of_many_photos_says_what_gaussians_are_worth(photos: int, pricing: int, device: Device) -> None:
    gaussians = synthetic_scene(9, 4)[0].astype(np.float32)
    assert len(unvalidated(gaussians, [photo("photo")] * photos, Renderer(device))) == pricing


def test_flat_walls_need_little(device: Device, tmp_path: Path) -> None:
    """Grey all around: what is off by less than a level in 255 is not improved. The start has 200 Gaussians, growth
    may go up to 7680; a tenth of these is enough. Measured on two processors: 171 and 293, without an error."""
    scene = known_scene(20, device, copies=10)
    walls = [replace(view, image=np.full_like(view.image, 128)) for view in (*scene.train, *scene.test)]
    scene = replace(scene, train=walls[:32], test=walls[32:])
    gaussians = train(scene, TrainConfig(iterations=2000), tmp_path, device)
    assert len(gaussians) < 768 and held_out(gaussians, scene, device) > 48
    trials = json.loads((tmp_path / "size.json").read_text())["trials"]
    assert max(max(trial["quality"]) for trial in trials) <= 20 * np.log10(255)


@pytest.mark.parametrize("iterations", [1, 4, 5, 6, 14])
@pytest.mark.parametrize("filtered", [False, True])
def test_the_shortest_runs_search_too(iterations: int, filtered: bool, device: Device, tmp_path: Path) -> None:
    """The first validation comes before the first iteration then."""
    config = replace(GROWING, iterations=iterations, coarse=CoarseConfig(factor=4), filter_3d=filtered)
    assert len(train(known_scene(20, device, copies=1, views=30), config, tmp_path, device))


def test_a_filter_is_measured_by_the_photos_that_train(device: Device) -> None:
    """Also by a training that has just resumed, and by the next iteration's photos."""
    scene = known_scene(20, device, copies=1, views=30)
    config = replace(CONFIG, filter_3d=True)
    training = Training(scene, config, device, initial_state(scene, config))
    training.refresh_filter()
    assert training.state.filter is not None
    measured = download(training.state.filter.pixels)
    training.state.filter.measure(
        training.renderer.stages, training.renderer.place(training.state.gaussians), split(scene.train)[0]
    )
    np.testing.assert_array_equal(measured, download(training.state.filter.pixels))


def test_too_few_photos_to_validate(device: Device, tmp_path: Path) -> None:
    """The size is not sought, and no strategy adds Gaussians."""
    scene = known_scene(5, device, copies=1, views=8)
    error = ErrorConfig(start=1, every=1)
    config = replace(CONFIG, iterations=20, strategy="error", error=error)
    assert len(scene.train) == 6
    gaussians = train(scene, config, tmp_path, device)
    assert len(gaussians) <= 5 and not (tmp_path / "size.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("count", "plateau", "best"), [(64, 120, 31.44), (128, 177, 30.89), (256, 507, 30.42)])
def test_it_finds_the_size_of_known_scenes(
    device: Device, tmp_path: Path, count: int, plateau: int, best: float
) -> None:
    """From eight times as many Gaussians as the photos show, at most three times the smallest size that reaches the
    plateau, at its quality within 0.2 dB. Pruning goes by halvings.

    `plateau`, `best`: of fixed sizes, factors of sqrt(2) apart, the smallest within 0.2 dB of the best and that one's
    quality (tests/training/measure_known.py).
    """
    scene = known_scene(count, device, copies=8)
    gaussians = train(scene, GROWING, tmp_path, device)
    assert plateau / 1.5 <= len(gaussians) <= 3 * plateau
    assert held_out(gaussians, scene, device) > best - 0.2


@pytest.mark.parametrize(("error", "expected"), [(0.1, 10), (1, 0), (0, PERFECT), (1e-9, PERFECT), (np.nan, np.nan)])
def test_decibels_end_at_one_level(error: float, expected: float) -> None:
    np.testing.assert_allclose(decibels(error), expected)
