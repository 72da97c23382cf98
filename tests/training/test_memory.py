"""Device memory: the prediction is what is allocated, a limit is kept, the steady state allocates nothing."""

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from every_strategy import with_rounds

from clsplat.buffers import Buffers
from clsplat.camera import Camera
from clsplat.config import AdcConfig, InitConfig, OptimConfig, RenderConfig, TrainConfig
from clsplat.device import Device
from clsplat.errors import DeviceError, InputError
from clsplat.gaussians import Gaussians
from clsplat.pruning.harmonics import curvatures
from clsplat.pruning.prices import price, removal_order
from clsplat.ranges import parse_bytes
from clsplat.render import render_views
from clsplat.renderer import Renderer
from clsplat.scene import DepthMap, Scene, View
from clsplat.testing import synthetic_scene
from clsplat.training.checkpoint import load_state
from clsplat.training.contributions import contributions
from clsplat.training.densify import STRATEGIES
from clsplat.training.loop import complete, train
from clsplat.training.memory import INTERSECTIONS, Footprint, Photos
from clsplat.training.run_length import with_length
from clsplat.training.session import Training
from clsplat.training.state import initial_state

FIXED_N = AdcConfig(stop_fraction=0)
"""No densification."""


def make_scene(n: int, width: int, height: int, views: int = 4) -> Scene:
    """Random points in photos of noise, from unlike distances, so that intersections differ."""
    rng = np.random.default_rng(0)
    cameras = [
        Camera.look_at(
            [(2.5 + i / 3) * np.sin(i), -0.5, (2.5 + i / 3) * np.cos(i)], [0, 0, 0], [0, -1, 0], width, width, height
        )
        for i in range(views)
    ]
    photos = [View(f"{i}", c, rng.integers(0, 256, (height, width, 3), np.uint8)) for i, c in enumerate(cameras)]
    return Scene(photos, [], rng.uniform(-1, 1, (n, 3)), rng.integers(0, 256, (n, 3), np.uint8))


@pytest.mark.parametrize(
    ("text", "expected"),
    [("4GB", 4 * 10**9), ("512MiB", 2**29), ("1.5 GB", 15 * 10**8), (".5GiB", 2**29), ("7MB", 7 * 10**6)],
)
def test_sizes(text: str, expected: int) -> None:
    assert parse_bytes(text, "--memory-limit") == expected


@pytest.mark.parametrize("text", ["4", "GB", "4gb", "-1GB", "0GB", "4GB more", "1e9MB", "4.5.6GB", ""])
def test_no_size(text: str) -> None:
    with pytest.raises(InputError, match=r"^--memory-limit: expected a size such as 4GB or 512MiB, found"):
        parse_bytes(text, "--memory-limit")


@pytest.mark.parametrize(("sort", "tile_size"), [("auto", "auto"), ("per_tile", "auto"), ("auto", 16)])
@pytest.mark.parametrize("gpu", [False, True], ids=["as it is", "as a GPU"])
@pytest.mark.parametrize(("n", "width", "height"), [(20_000, 160, 120), (5_000, 400, 300)])
def test_what_is_predicted_is_allocated(
    tmp_path: Path,
    gpu: bool,
    n: int,
    width: int,
    height: int,
    sort: Literal["auto", "per_tile"],
    tile_size: Literal["auto", 16],
) -> None:
    device = Device()
    if gpu:
        device.is_cpu = False  # type: ignore[misc]  # shadows the cached property
    scene = make_scene(n, width, height)
    config = TrainConfig(
        strategy="adc",
        size="fixed",
        iterations=6,
        eval_every=3,
        adc=FIXED_N,
        render=RenderConfig(sort=sort, tile_size=tile_size),
        exposure=gpu,
        init=InitConfig(dense=False),  # dense points are found before the training, in a memory of their own
    )

    def evaluate(gaussians: Gaussians) -> dict[str, float]:
        return {
            "mean": float(np.mean([r.rgb.mean() for r in render_views(gaussians, cameras, config.render, device)]))
        }

    cameras = [view.camera for view in scene.train]
    train(scene, config, tmp_path, device, evaluate=evaluate)
    met = load_state(tmp_path / "checkpoint.npz", scene.extent, with_length(config, scene)).intersections
    photos = sum(view.image.nbytes for view in scene.train)
    predicted = Footprint.of(scene, config, device).total(n, met) + photos
    assert device.memory_peak <= predicted <= 1.2 * device.memory_peak


def test_depth_maps_are_predicted(tmp_path: Path) -> None:
    scene, device = make_scene(5000, 160, 120), Device()
    depth = DepthMap(np.full((120, 160), 3, np.float32))
    scene = replace(scene, train=[replace(view, depth=depth) for view in scene.train])
    config = TrainConfig(strategy="adc", size="fixed", iterations=6, adc=FIXED_N, eval_every=0)
    training = Training(scene, config, device, initial_state(scene, config))
    complete(training, tmp_path)
    photos = sum(view.image.nbytes + depth.disparities.nbytes for view in scene.train)
    met = training.state.intersections
    assert device.memory_peak <= training.need.total(5000, met) + photos <= 1.2 * device.memory_peak
    assert replace(training.need, depth=False).total(5000, met) + photos < device.memory_peak


def test_a_backdrop_is_predicted(tmp_path: Path) -> None:
    scene, device = make_scene(5000, 160, 120), Device()
    config = TrainConfig(strategy="adc", size="fixed", iterations=6, adc=FIXED_N)
    state = initial_state(scene, config)
    training = Training(scene, config, device, state, backdrop=initial_state(scene, config).gaussians)
    complete(training, tmp_path)
    photos = sum(view.image.nbytes for view in scene.train)
    need = training.need
    assert need.backdrop == 5000
    predicted = need.total(5000, training.state.intersections) + photos
    assert device.memory_peak <= predicted <= 1.2 * device.memory_peak
    # Without the backdrop's bytes the prediction would be too low.
    assert replace(need, backdrop=0).total(5000, training.state.intersections) + photos < device.memory_peak
    assert abs(need.most_gaussians(need.total(5000)) - 5000) <= 1


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_the_projection_along_rays_is_predicted(tmp_path: Path, model: Literal["pinhole", "fisheye"]) -> None:
    scene, device = make_scene(5000, 160, 120), Device()
    views = [replace(view, camera=replace(view.camera, model=model)) for view in scene.train]
    scene = replace(scene, train=views, test=[])
    render = RenderConfig(projection="ray")
    config = TrainConfig(strategy="adc", size="fixed", iterations=6, adc=FIXED_N, eval_every=0, render=render)
    training = Training(scene, config, device, initial_state(scene, config))
    complete(training, tmp_path)
    photos = sum(view.image.nbytes for view in scene.train)
    met = training.state.intersections
    assert device.memory_peak <= training.need.total(5000, met) + photos <= 1.2 * device.memory_peak
    assert replace(training.need, rays=0).total(5000, met) + photos < device.memory_peak


def test_a_million_gaussians_fit_4_gb() -> None:
    """At 1280x720, with intersections to spare and an evaluation's copy."""
    for gpu in (False, True):
        assert Footprint(1280, 720, 3, gpu).total(1_000_000, 2 * INTERSECTIONS) < 4e9


def test_the_steady_state_allocates_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = Device()
    done: list[int] = []
    new: list[int] = []
    allocate = Buffers.allocate

    def counted(self: Buffers, what: str, nbytes: int) -> Any:
        before = self.memory
        block = allocate(self, what, nbytes)
        if self.memory != before:
            new.append(len(done))
        return block

    monkeypatch.setattr(Buffers, "allocate", counted)
    still = OptimConfig(1e-9, 1e-9, log_scales_lr=0, quats_lr=0, logit_opacities_lr=0)  # lists stay as they are
    config = TrainConfig(strategy="adc", size="fixed", iterations=30, adc=FIXED_N, optim=still)
    train(make_scene(2000, 96, 64, 6), config, tmp_path, device, progress=lambda _: done.append(1))
    # Each of the 6 views comes for the first time, with lists of its own length.
    assert set(new) > {0} and max(new) < 6


def test_most_gaussians_is_the_inverse_of_total() -> None:
    need = Footprint(640, 480, 3, False)
    for limit in (10**9, 123_456_789):
        n = need.most_gaussians(limit)
        assert need.total(n) <= limit < need.total(n + 2)
    assert need.most_gaussians(need.fixed) == need.most_gaussians(0) == 0


def test_a_start_that_does_not_fit_says_what_would() -> None:
    need = Footprint(1600, 1200, 3, False)
    assert "enough for" in need.describe(100, 1000, 10**9)
    with pytest.raises(InputError, match=r"^--memory-limit: expected at least") as error:
        need.check(200_000, 400_000_000)
    assert f"{need.most_gaussians(400_000_000)} Gaussians with all of them: --downscale 2" in str(error.value)
    for limit, remedy in ((400_000_000, 4), (Footprint(1200, 900, 3, False).total(200_000) - 1, 8)):
        with pytest.raises(InputError, match=rf"with all of them: --downscale {remedy}$"):
            need.check(200_000, limit, 3)
    for start, limit, downscale in ((10**6, 300_000_000, 1), (200_000, 400_000_000, 16)):
        with pytest.raises(InputError) as error:
            need.check(start, limit, downscale)
        assert "downscale" not in str(error.value)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_growth_stops_where_memory_ends(tmp_path: Path, strategy: str) -> None:
    scene = make_scene(1500, 96, 64)
    adc = AdcConfig(grad_threshold=1e-7)
    init = InitConfig(dense=False)
    config = TrainConfig(size="fixed", iterations=30, strategy=strategy, max_gaussians=12_000, adc=adc, init=init)
    config = with_rounds(config, start=1, every=5, stop_fraction=1)
    still, free = Device(), Device()
    train(scene, with_rounds(config, stop_fraction=0), tmp_path, still)
    grown = len(train(scene, config, tmp_path, free))
    limit = (still.memory_peak + free.memory_peak) // 2
    device = Device(memory_limit=limit)
    with pytest.warns(UserWarning, match=r"no more than \d+ Gaussians fit the memory: growth stops"):
        held = train(scene, config, tmp_path, device)
    assert 1500 < len(held) < 0.8 * grown  # about half of what growth adds fits; a round takes memory, too
    assert device.memory_peak <= limit
    numbers = [json.loads(line)["num_gaussians"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert numbers[-1] == len(held)


def test_photos_stay_within_their_budget(device: Device) -> None:
    views = make_scene(1, 32, 16).train
    size = views[0].image.nbytes
    photos = Photos(device)
    photos.keep_within(2 * size)
    first = [photos(view)[0] for view in views]
    again = [photos(view)[0] for view in views]
    assert [a is b for a, b in zip(first, again, strict=True)] == [True, True, False, False]
    for view, photo in zip(views, first, strict=True):
        np.testing.assert_array_equal(photo.get(), view.image)
    photos.keep_within(size)
    assert [photos(view)[0] is a for view, a in zip(views, first, strict=True)] == [True, False, False, False]
    photos.keep_within(-1)
    assert photos(views[0])[0] is not first[0]


def test_masks_count_too(device: Device) -> None:
    views = [replace(v, mask=np.ones((16, 32), bool)) for v in make_scene(1, 32, 16).train]
    photos = Photos(device)
    photos.keep_within(views[0].image.nbytes + 32 * 16 - 1)
    assert photos(views[0])[0] is not photos(views[0])[0]


def test_running_out_of_memory_leaves_the_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, device = make_scene(300, 48, 32), Device()
    config = TrainConfig(strategy="adc", size="fixed", iterations=12, checkpoint_every=5, adc=FIXED_N)
    done: list[int] = []
    allocate = Buffers.allocate

    def full(self: Buffers, what: str, nbytes: int) -> Any:
        if len(done) == 7:
            raise DeviceError(f"{what}: no memory left")
        return allocate(self, what, nbytes)

    with monkeypatch.context() as patch:
        patch.setattr(Buffers, "allocate", full)
        with pytest.raises(
            DeviceError, match=r"^iteration 8: .*: no memory left; the last checkpoint in .* is intact"
        ):
            train(scene, config, tmp_path, device, progress=lambda record: done.append(record["iteration"]))
    assert load_state(tmp_path / "checkpoint.npz", scene.extent, with_length(config, scene)).iteration == 5
    resumed = train(scene, replace(config, memory_limit="1GB"), tmp_path, device, resume=True)
    expected = train(scene, config, tmp_path, device)
    assert all((a == b).all() for a, b in zip(resumed.arrays().values(), expected.arrays().values(), strict=True))


def test_a_limit_does_not_change_the_result_where_it_holds_nothing_back(tmp_path: Path) -> None:
    scene, config = make_scene(300, 48, 32), TrainConfig(strategy="adc", size="fixed", iterations=8, adc=FIXED_N)
    free = Device()
    expected = train(scene, config, tmp_path, free)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Too little for the photos beside the rest: they are uploaded anew each time.
        result = train(scene, config, tmp_path, Device(memory_limit=free.memory_peak))
    assert all((a == b).all() for a, b in zip(result.arrays().values(), expected.arrays().values(), strict=True))


@pytest.mark.parametrize(
    "survey",
    [
        lambda renderer, gaussians, views: contributions(renderer, gaussians, views),
        lambda renderer, gaussians, views: price(gaussians, views, renderer),
        lambda renderer, gaussians, views: removal_order(gaussians, views, lambda _: True, renderer),
        lambda renderer, gaussians, views: curvatures(gaussians, views, renderer),
    ],
    ids=["contributions", "price", "removal_order", "curvatures"],
)
def test_a_surveyed_photo_is_released_before_the_next(survey: Callable[..., Any]) -> None:
    scene = make_scene(1, 96, 64, views=1)
    gaussians = synthetic_scene(3000)[0].astype(np.float32)
    peaks = []
    for count in (1, 3):
        device = Device()
        survey(Renderer(device), gaussians, scene.train * count)
        peaks.append(device.memory_peak)
    assert peaks[1] <= 1.2 * peaks[0], "a render takes three tenths, what the pool keeps of it one"
