"""The optimiser's moments follow their rows; the schedules at their ends."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from clsplat import reference
from clsplat.config import OptimConfig, TrainConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer, download, fetch
from clsplat.stages import Image
from clsplat.testing import synthetic_scene
from clsplat.training.optimizer import Adam, Moments, Optimizer, adam_settings, sh_degree_at

CONFIG = OptimConfig()


def test_moments_follow_their_rows() -> None:
    start = synthetic_scene(4, seed=3)[0]
    moments = Moments.zeros(start)
    moments.first.means[:] = np.arange(4)[:, None]
    moments.second.sh[:] = np.arange(4)[:, None, None]
    taken = moments.take(np.array([3, 1]))
    assert taken.first.means[:, 0].tolist() == [3, 1]
    assert taken.second.sh[:, 0, 0].tolist() == [3, 1]
    taken.first.means[:] = 7
    assert moments.first.means[:, 0].tolist() == [0, 1, 2, 3]


def test_schedules_at_their_ends() -> None:
    first, last = adam_settings(1, 0.0, 3.0, CONFIG, 3), adam_settings(1000, 1.0, 3.0, CONFIG, 2)
    assert (first.iteration, last.iteration) == (1, 1000)
    assert first.rates["means"] == pytest.approx(3 * CONFIG.means_lr)
    assert last.rates["means"] == pytest.approx(3 * CONFIG.means_lr_final)
    before, falling = (adam_settings(1, progress, 3.0, CONFIG, 3) for progress in (0.6, 0.8))
    for name in ("log_scales", "quats", "logit_opacities", "sh0", "sh_rest"):
        assert first.rates[name] == before.rates[name] == getattr(CONFIG, f"{name}_lr")
        assert falling.rates[name] == pytest.approx(0.1**0.5 * first.rates[name])
        assert last.rates[name] == pytest.approx(0.1 * first.rates[name])
    lower = adam_settings(1, 0.8, 3.0, CONFIG, 3, factor=0.5)
    assert lower.rates == pytest.approx({name: 0.5 * rate for name, rate in falling.rates.items()})
    assert [sh_degree_at(i, 1000, 3) for i in (1, 1000, 1001, 3001, 9999)] == [0, 0, 1, 3, 3]
    assert sh_degree_at(9999, 1000, 1) == 1


def test_short_runs_shorten_their_schedules() -> None:
    assert [TrainConfig(iterations=n).shortened(500) for n in (30_000, 7000, 700, 1)] == [500, 500, 50, 1]


def test_adam_for_loops_of_ones_own_is_that_of_training(device: Device) -> None:
    """Its steps are those of the twin with the settings of training, wherever the gradients are."""
    rng = np.random.default_rng(0)
    gaussians = synthetic_scene(30, sh_degree=2)[0].astype(np.float32)
    config = OptimConfig(sh_degree_every=2)
    adam = Adam(gaussians, Renderer(device), 4, 2.5, config)
    expected, moments = gaussians.astype(np.float64), Moments.zeros(gaussians.astype(np.float64))
    for iteration in range(1, 6):
        v = Gaussians(**{k: rng.normal(size=a.shape) for k, a in gaussians.arrays().items()}).astype(np.float32)
        degree = sh_degree_at(iteration, 2, 2)
        assert adam.sh_degree == degree
        adam.step(v if iteration % 2 else adam._renderer.place(v))
        settings = adam_settings(iteration, min(1.0, (iteration - 1) / 3), 2.5, config, degree)
        reference.adam_step(expected, v.astype(np.float64), moments.first, moments.second, settings)
    for name, array in fetch(adam.gaussians).arrays().items():
        np.testing.assert_allclose(array, expected.arrays()[name], rtol=1e-4, atol=1e-5)
    assert adam.iteration == 5 and adam.gaussians is not gaussians


def test_names_at_the_top_of_the_package() -> None:
    from clsplat import training

    assert {"Adam", "Strategy", "initialize", "train"} <= set(training.__all__)
    assert callable(training.initialize) and training.STRATEGIES["error"] is not None


@pytest.mark.parametrize("kind", ["device", "numpy"])
def test_gaussians_keep_their_opacity_until_a_photo_shows_them(
    device: Device, kind: Literal["device", "numpy"]
) -> None:
    """Their moments are 0 at first, so that a penalty alone would move them by whole steps. Each photo of a large
    scene shows few of them."""
    gaussians, camera = synthetic_scene(30)
    away = replace(camera, viewmat=np.diag([-1.0, 1, -1, 1]) @ camera.viewmat)
    renderer = Renderer(device)
    optimizer = Optimizer(renderer, kind)
    start = gaussians.astype(np.float32)
    opacities = []
    for looking in (away, camera):
        place = renderer.place if kind == "device" else fetch
        trained, zeros = place(start.astype(np.float32)), [place(g) for g in vars(Moments.zeros(start)).values()]
        run = renderer.forward(trained, looking)
        black = Image(*(renderer.zeros("black", shape) for shape in (run.image.rgb.shape, run.image.alpha.shape)))
        for iteration in range(1, 21):
            run = renderer.forward(trained, looking)
            settings = adam_settings(iteration, 0.0, 1.0, CONFIG, 0, (1e-6, 0.0, 0.0))
            v_splats = renderer.backward_to_splats(run, black)
            optimizer.step(trained, Moments(*zeros), None, run, v_splats, settings)
        opacities.append(fetch(trained).opacities)
    np.testing.assert_array_equal(opacities[0], start.opacities)
    shown = download(run.splats.extents)[:, 0] > 0
    assert (opacities[1] < start.opacities)[shown].all() and shown.sum() > 20
