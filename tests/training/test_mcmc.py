"""Relocation, growth, noise and penalties of the strategy mcmc."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.config import McmcConfig, OptimConfig, TrainConfig
from clsplat.gaussians import Gaussians, logit, sigmoid
from clsplat.reference.adam import adam_step
from clsplat.testing import synthetic_scene
from clsplat.training.densify import Contributions
from clsplat.training.densify.mcmc import COPIES_MAX, Mcmc, integral, interval, sample, share
from clsplat.training.optimizer import adam_settings

N = 300
CONFIG = TrainConfig(size="fixed", iterations=2000, strategy="mcmc", max_gaussians=N)


def survey(views: int, fraction: float) -> Contributions:
    raise AssertionError("this strategy asks for no survey")


def scene(dead: int = 0) -> Gaussians:
    gaussians = synthetic_scene(N, seed=3)[0].astype(np.float32)
    gaussians.logit_opacities[:] = logit(np.linspace(0.1, 0.9, N))
    gaussians.logit_opacities[:dead] = logit(0.004)
    return gaussians


@pytest.mark.parametrize("copies", [2, 3, 10, COPIES_MAX])
@pytest.mark.parametrize("opacity", [0.3, 0.7, 0.95])
def test_shared_gaussians_look_like_the_one(opacity: float, copies: int) -> None:
    """Composited one behind the other, at the centre and integrated along a line."""
    one = scene().take(np.zeros(copies, int))
    one.logit_opacities[:] = logit(opacity)
    before = one.scales[0].astype(np.float64)
    share(one, np.full(copies, copies), 1e-4)
    x = np.linspace(-12, 12, 20001)
    shared = sigmoid(one.logit_opacities[0].astype(np.float64))
    ratio = one.scales[0] / before
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)
    alpha = 1 - (1 - shared * np.exp(-0.5 * (x / ratio[0]) ** 2)) ** copies
    # float32 parameters of up to 51 copies.
    assert alpha.max() == pytest.approx(opacity, rel=1e-4)
    assert alpha.sum() * (x[1] - x[0]) == pytest.approx(opacity * np.sqrt(2 * np.pi), rel=1e-4)
    # Flat-topped without the change of scales: the test could tell.
    assert ratio[0] < 1 - 0.05 * opacity


def test_integral_is_that_of_one_gaussian_for_one_copy() -> None:
    np.testing.assert_allclose(integral(np.array([0.2, 0.9]), np.array([1, 1])), [0.2, 0.9], rtol=1e-15)


def test_shares_never_die() -> None:
    gaussians = scene().take(np.zeros(4, int))
    gaussians.logit_opacities[:] = [logit(0.02), logit(0.0051), 40.0, logit(0.5)]
    share(gaussians, np.array([100, 2, 7, 1]), 0.005)
    assert (gaussians.opacities >= 0.005 * (1 - 1e-5)).all()
    assert all(np.isfinite(a).all() for a in gaussians.arrays().values())
    assert gaussians.opacities[3] == np.float32(0.5)


def test_dead_gaussians_move_onto_live_ones() -> None:
    dead = 20
    strategy, gaussians = Mcmc(CONFIG, 1.0, N), scene(dead)
    edit = strategy.edit(600, gaussians, N, survey)
    assert len(edit.rows) == N  # full: nothing is added
    assert (edit.rows[:dead] >= dead).all()
    assert (edit.rows[dead:] == np.arange(dead, N)).all()
    sources = np.unique(edit.rows[:dead])
    touched = np.union1d(np.arange(dead), sources)
    assert np.flatnonzero(edit.fresh).tolist() == touched.tolist()
    np.testing.assert_array_equal(edit.gaussians.means, gaussians.means[edit.rows])
    # What coincides is as opaque together as the one was.
    for source in sources:
        group = np.flatnonzero(edit.rows == source)
        together = 1 - np.prod(1 - edit.gaussians.opacities[group].astype(np.float64))
        assert together == pytest.approx(gaussians.opacities[source], rel=1e-4)
    others = np.setdiff1d(np.arange(N), touched)
    np.testing.assert_array_equal(edit.gaussians.logit_opacities[others], gaussians.logit_opacities[others])


def test_new_gaussians_are_added_to_relocated_ones() -> None:
    strategy, gaussians = Mcmc(CONFIG, 1.0, N), scene(20)
    edit = strategy.edit(1600, gaussians, N + 50, survey)  # growth is late: all at once
    assert len(edit.rows) == N + 50
    assert edit.fresh[N:].all()
    assert (edit.fresh == (np.bincount(edit.rows)[edit.rows] > 1)).all()
    for source in np.unique(edit.rows):
        group = np.flatnonzero(edit.rows == source)
        together = 1 - np.prod(1 - edit.gaussians.opacities[group].astype(np.float64))
        assert together == pytest.approx(gaussians.opacities[source], rel=1e-4)


def test_nothing_lives() -> None:
    strategy, gaussians = Mcmc(CONFIG, 1.0, N), scene(N)
    edit = strategy.edit(600, gaussians, 2 * N, survey)
    assert (edit.rows == np.arange(N)).all() and not edit.fresh.any()


def test_draws_are_in_proportion_to_their_weights() -> None:
    weights, n = np.array([1, 0, 5, 2]), 100_000
    counts = np.bincount(sample(weights, n, np.random.default_rng(0)), minlength=4)
    expected = n * weights / weights.sum()
    # Five standard deviations of a count.
    assert (np.abs(counts - expected) <= 5 * np.sqrt(expected)).all()


def test_penalties_weigh_means() -> None:
    """Of opacities, and of scales in extents of the scene, by finite differences."""
    extent, config = 3.0, McmcConfig(opacity_penalty=0.3, scale_penalty=0.7)
    gaussians = scene().astype(np.float64)
    strategy = Mcmc(replace(CONFIG, mcmc=config), extent, N)

    def loss(g: Gaussians) -> float:
        return float(0.3 * g.opacities.mean() + 0.7 * (g.scales / extent).mean())

    zeros = [Gaussians(**{k: np.zeros_like(a) for k, a in gaussians.arrays().items()}) for _ in range(3)]
    step = adam_settings(1, 0.0, extent, OptimConfig(), 0)._replace(penalties=(*strategy.penalties(N), 0.0))
    adam_step(gaussians.astype(np.float64), *zeros, step)
    for name, row in (("log_scales", (7, 1)), ("logit_opacities", (9,))):
        values = []
        for sign in (1, -1):
            moved = gaussians.astype(np.float64)
            getattr(moved, name)[row] += sign * 1e-5
            values.append(loss(moved))
        expected = (values[0] - values[1]) / 2e-5
        assert getattr(zeros[1], name)[row] / 0.1 == pytest.approx(expected, rel=1e-5)


def test_noise_does_not_depend_on_the_unit_of_length() -> None:
    """The size of the noise is an inverse length."""
    sizes = []
    for unit in (1.0, 100.0):
        strategy = Mcmc(CONFIG, 2.0 * unit, N)
        stage = SimpleNamespace(add_noise=lambda g, size, seed, i: sizes.append((size, seed, i)))
        strategy.perturb(stage, scene(), 7, 1e-3 * unit)
    assert sizes[0] == (CONFIG.mcmc.noise_lr * 1e-3 / 4, CONFIG.seed, 7)
    assert sizes[1][0] == pytest.approx(sizes[0][0] / 100)
    off = Mcmc(replace(CONFIG, mcmc=McmcConfig(noise_lr=0)), 1.0, N)
    off.perturb(SimpleNamespace(), scene(), 7, 1e-3)


@pytest.mark.parametrize(
    ("size", "iterations", "expected"), [("auto", 1500, 50), ("auto", 9000, 100), ("fixed", 1500, 100)]
)
def test_rounds_of_a_short_search_are_closer(size: str, iterations: int, expected: int) -> None:
    """As many as in 3000 iterations; longer runs have more."""
    assert McmcConfig().every == 100
    assert interval(replace(CONFIG, size=size, iterations=iterations)) == expected
