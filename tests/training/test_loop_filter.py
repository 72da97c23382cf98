"""Training under Mip-Splatting's 3D filter: what is saved contains it, and runs still resume and repeat."""

from dataclasses import replace

import numpy as np
import pytest
from small_run import CONFIG, same

from clsplat import reference
from clsplat.constants import FILTER_VARIANCE
from clsplat.renderer import fetch
from clsplat.training.autosize import search
from clsplat.training.checkpoint import load_state
from clsplat.training.densify.strategy import MOST_GAUSSIANS
from clsplat.training.loop import train
from clsplat.training.session import Training
from clsplat.training.state import initial_state

FILTERED = replace(CONFIG, filter_3d=True)


def thinnest(gaussians, cameras):
    """Smallest scale, in those of the filter."""
    pixels = reference.pixel_sizes(gaussians, cameras)
    return float((gaussians.scales.min(axis=1) / (np.sqrt(FILTER_VARIANCE) * pixels)).min())


@pytest.fixture
def needles(scene):
    """So many points that Gaussians start far smaller than a pixel."""
    points = np.random.default_rng(0).normal(0, 0.02, (80, 3))
    return replace(scene, points=points, colors=np.full(points.shape, 128, np.uint8))


def test_nothing_is_thinner_than_the_filter(needles, device, tmp_path):
    cameras = [view.camera for view in needles.train]
    evaluated = []

    def evaluate(gaussians):
        evaluated.append(thinnest(fetch(gaussians), cameras))
        return {}

    plain = train(needles, CONFIG, tmp_path / "False", device)
    config = replace(FILTERED, eval_every=10)
    shown = train(needles, config, tmp_path / "True", device, evaluate=evaluate)
    assert thinnest(plain, cameras) < 0.5, "the scene must be too fine without the filter"
    assert thinnest(shown, cameras) > 0.99  # means have moved since the sizes were measured
    assert len(evaluated) == 6 and min(evaluated) > 0.99, "after an edit, too"
    raw = load_state(tmp_path / "True" / "checkpoint.npz", needles.extent, FILTERED).gaussians
    assert thinnest(raw, cameras) < 0.9, "what trains is not what is shown"


@pytest.mark.parametrize("strategy", ["adc", "error"])
def test_a_run_that_was_interrupted_ends_with_the_same_bits(needles, device, tmp_path, strategy):
    config = replace(FILTERED, strategy=strategy, max_gaussians=100)
    whole = train(needles, config, tmp_path / "whole", device)

    def stop(record):
        if record["iteration"] == 37:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(needles, config, tmp_path / "cut", device, progress=stop)
    assert same(train(needles, config, tmp_path / "cut", device, resume=True), whole)


def test_both_optimisers_train_alike(needles, device, tmp_path):
    ends = [
        train(needles, replace(FILTERED, iterations=9, optimizer=o), tmp_path / o, device)
        for o in ("device", "numpy")
    ]
    for name in ("means", "log_scales", "logit_opacities", "sh"):  # spheres have no orientation but rounding
        array = getattr(ends[0], name)
        np.testing.assert_allclose(array, getattr(ends[1], name), rtol=1e-3, atol=1e-4, err_msg=name)


def test_a_reset_lowers_what_is_shown(needles, device, tmp_path):
    """To the reset's value, and not by what the filter takes off as well: below ALPHA_MIN no gradient comes back."""
    config = replace(FILTERED, adc=replace(CONFIG.adc, every=7))
    state = initial_state(needles, config)
    state.iteration = 30
    state.gaussians.logit_opacities[:] = 3
    training = Training(needles, config, device, state)
    training.refresh_filter()
    before, pixels = fetch(state.shown(training.renderer)).opacities, state.filter.pixels
    training.densify(MOST_GAUSSIANS)
    state.filter.pixels = pixels
    after = fetch(state.shown(training.renderer)).opacities
    assert before.min() < 0.1 < before.max(), "the filter must matter"
    np.testing.assert_allclose(after, np.minimum(before, config.adc.reset_opacity), rtol=1e-3)


def test_the_search_for_the_size_sees_what_is_shown(needles, device, tmp_path):
    """What is validated, and what the run ends with, is under the filter; resumed, to the same bits."""
    config = replace(FILTERED, size="auto", iterations=100, size_price=8.0, checkpoint_every=1000)
    cameras = [view.camera for view in needles.train]
    validated = []
    validate = search.validate

    def spy(gaussians, *rest, **options):
        validated.append(thinnest(fetch(gaussians), cameras))
        return validate(gaussians, *rest, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "validate", spy)
        whole = train(needles, config, tmp_path / "whole", device)
    assert len(validated) > 4 and min(validated) > 0.99
    assert len(whole) < len(needles.points) and thinnest(whole, cameras) > 0.99

    def stop(record):
        if record["iteration"] == 67:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(needles, config, tmp_path / "cut", device, progress=stop)
    assert same(train(needles, config, tmp_path / "cut", device, resume=True), whole)
