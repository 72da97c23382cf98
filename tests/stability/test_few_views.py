"""Few photos, which many arrangements of Gaussians explain equally well (Park et al. 2025, "DropGaussian")."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.bench.stability.small import CONFIG, SIZE, small_scene, with_train
from clsplat.evaluate import mean_metrics
from clsplat.renderer import Renderer
from clsplat.training import few_views
from clsplat.training.initialize import start_count
from clsplat.training.loop import train
from clsplat.training.presets import PRESETS, load_preset


def noisy(view, rng):
    noise = rng.normal(0, 25, view.image.shape)
    return replace(view, image=np.clip(view.image + noise, 0, 255).astype(np.uint8))


@pytest.fixture(scope="module")
def scene(device):
    """Three noisy photos of a third of the circle, and points away from the scene."""
    scene, rng = with_train(small_scene(device), noisy), np.random.default_rng(1)
    points = rng.uniform(-0.8, 0.8, (150, 3))
    colors = rng.integers(0, 256, points.shape, dtype=np.uint8)
    return replace(scene, train=scene.train[:5:2], test=scene.test[:1], points=points, colors=colors)


def test_three_photos_do_not_overfit(scene, device, tmp_path):
    """Without the remedy, Gaussians are added until they show the noise of each photo."""
    psnr = {}
    plain = replace(CONFIG, iterations=400, max_gaussians=1000)
    for config in (plain, few_views.adapted(plain, scene)):
        psnr[config != plain] = mean_metrics(train(scene, config, tmp_path, device), scene.test, Renderer(device))[
            "psnr"
        ]
    # Measured: 20.8 dB and 23.3 dB.
    assert psnr[True] > psnr[False] + 1.5


def test_settings_for_few_photos(scene):
    config, points = replace(CONFIG, max_gaussians=None), len(scene.points)
    few = few_views.adapted(config, scene)
    assert (few.max_gaussians, few.dropout) == (8 * points, 0.2)
    for times, most in ((2, SIZE[0] * SIZE[1]), (3, 12 * points)):  # 2400 and 3600 are more than the pixels
        more = replace(scene, points=np.tile(scene.points, (times, 1)))
        assert few_views.adapted(config, more).max_gaussians == most
    large = with_train(scene, lambda view, rng: replace(view, camera=view.camera.resized(600, 600)))
    assert few_views.adapted(config, large).max_gaussians == round(90_000 * 2**0.5)
    assert few_views.adapted(few, scene) == few, "a resumed run, and one from its config.json, continue"
    for named in (7, 10**6):
        assert few_views.adapted(replace(config, max_gaussians=named), scene).max_gaussians == named
    assert few_views.adapted(replace(config, size="auto", max_gaussians=7), scene).max_gaussians == 7
    assert few_views.adapted(replace(config, size="auto", max_gaussians=10**6), scene) == few
    assert few_views.adapted(replace(config, size="auto"), scene) == few, "too few photos to search for the size"
    pointless = replace(scene, points=scene.points[:0])
    assert few_views.adapted(config, pointless).max_gaussians is None, "a random start has the configuration's cap"
    sought = few_views.adapted(replace(config, size="auto"), pointless)
    assert (sought.size, sought.max_gaussians) == ("fixed", 4 * start_count(pointless, sought.init, None)), (
        "more than the pixels"
    )
    assert few_views.adapted(config, replace(scene, train=scene.train * 5)) != config
    assert few_views.adapted(config, replace(scene, train=scene.train * 6)) == config, "18 photos"


def test_the_size_is_searched_from_24_photos_on(scene):
    """With 17 to 23 the number grows as far as a search would let it."""
    config, points = replace(CONFIG, size="auto", max_gaussians=None), len(scene.points)
    some, many = (replace(scene, train=scene.train * times) for times in (7, 8))
    fixed = few_views.adapted(config, some)
    assert fixed == replace(config, size="fixed", max_gaussians=max(3 * points, SIZE[0] * SIZE[1]), dropout=0.1)
    assert few_views.adapted(config, replace(some, points=np.zeros((1000, 3)))).max_gaussians == 3000
    assert few_views.adapted(replace(config, max_gaussians=7), some).max_gaussians == 7
    assert few_views.adapted(fixed, some) == fixed, "a resumed run continues"
    assert few_views.adapted(config, many) == config
    as_many = replace(config, few=replace(config.few, below=0))
    assert few_views.adapted(as_many, some) == as_many
    assert few_views.adapted(as_many, scene) == replace(fixed, few=as_many.few, dropout=0.0), "no search is possible"


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_the_same_with_few_photos(name, scene):
    """They are named after papers, which have no such settings."""
    assert few_views.adapted(load_preset(name), scene) == load_preset(name)


def test_dropout_is_part_of_the_training_and_rises(scene, device, tmp_path, monkeypatch):
    rates, forward = [], Renderer.forward

    def watched(*args, **options):
        rates.append(options["dropout"].rate)
        return forward(*args, **options)

    config = replace(CONFIG, iterations=21, dropout=0.2)
    monkeypatch.setattr(Renderer, "forward", watched)
    found = train(scene, config, tmp_path, device)
    np.testing.assert_allclose(rates, np.linspace(0, 0.2, 21))
    monkeypatch.undo()
    without = train(scene, replace(config, dropout=0.0), tmp_path, device)
    assert (found.means != without.means).any()
