"""Adam against its definition, one scalar at a time; the schedules at their ends."""

import numpy as np
import pytest

from clsplat.config import OptimConfig, TrainConfig
from clsplat.gaussians import SHAPES, Gaussians
from clsplat.optim import BLOCK, Moments, adam_step, learning_rates, sh_degree_at
from clsplat.testing import synthetic_scene

CONFIG = OptimConfig()


def random_like(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    return Gaussians(**{k: rng.standard_normal(a.shape) for k, a in gaussians.arrays().items()})


def scalar_adam(p: float, gradients: list[float], rate: float) -> float:
    """Algorithm 1 of Kingma and Ba 2015, written for one number."""
    m = v = 0.0
    for t, g in enumerate(gradients, start=1):
        m = CONFIG.beta1 * m + (1 - CONFIG.beta1) * g
        v = CONFIG.beta2 * v + (1 - CONFIG.beta2) * g * g
        m_hat, v_hat = m / (1 - CONFIG.beta1**t), v / (1 - CONFIG.beta2**t)
        p -= rate * m_hat / (v_hat**0.5 + CONFIG.eps)
    return p


def test_every_entry_follows_the_definition() -> None:
    # More rows than one block of the widest field, so that block borders are crossed.
    n = BLOCK // 48 + 3
    start = synthetic_scene(n, seed=1)[0].astype(np.float64)
    rng = np.random.default_rng(0)
    gradients = [random_like(start, rng) for _ in range(3)]
    rates = learning_rates(1, 100, 2.0, CONFIG)
    trained, moments = start.astype(np.float64), Moments.zeros(start)
    for t, gradient in enumerate(gradients, start=1):
        adam_step(trained, gradient, moments, rates, t, trained.sh_degree, CONFIG)
    for name in SHAPES:
        flat = [getattr(g, name).reshape(n, -1) for g in (start, trained, *gradients)]
        for row, column in [(0, 0), (n - 1, 0), (n - 1, flat[0].shape[1] - 1), (BLOCK // 48, 0)]:
            rate = rates.get(name) or rates["sh0" if column < 3 else "sh_rest"]
            expected = scalar_adam(flat[0][row, column], [g[row, column] for g in flat[2:]], rate)
            assert flat[1][row, column] == pytest.approx(expected, rel=1e-12), (name, row, column)


def test_bands_that_are_not_trained_do_not_move() -> None:
    start = synthetic_scene(5, seed=2)[0].astype(np.float64)
    trained, moments = start.astype(np.float64), Moments.zeros(start)
    gradient = random_like(start, np.random.default_rng(0))
    adam_step(trained, gradient, moments, learning_rates(1, 10, 1.0, CONFIG), 1, 1, CONFIG)
    assert (trained.sh[:, :4] != start.sh[:, :4]).all()
    assert (trained.sh[:, 4:] == start.sh[:, 4:]).all()


def test_moments_follow_their_rows() -> None:
    start = synthetic_scene(4, seed=3)[0]
    moments = Moments.zeros(start)
    moments.first.means[:] = np.arange(4)[:, None]
    moments.second.sh[:] = np.arange(4)[:, None, None]
    moved = moments.take(np.array([3, 1, 1]), np.array([False, False, True]))
    assert moved.first.means[:, 0].tolist() == [3, 1, 0]
    assert moved.second.sh[:, 0, 0].tolist() == [3, 1, 0]
    assert moments.first.means[:, 0].tolist() == [0, 1, 2, 3]


def test_schedules_at_their_ends() -> None:
    first, last = learning_rates(1, 1000, 3.0, CONFIG), learning_rates(1000, 1000, 3.0, CONFIG)
    assert first["means"] == pytest.approx(3 * CONFIG.means_lr)
    assert last["means"] == pytest.approx(3 * CONFIG.means_lr_final)
    assert [sh_degree_at(i, 1000, 3) for i in (1, 1000, 1001, 3001, 9999)] == [0, 0, 1, 3, 3]
    assert sh_degree_at(9999, 1000, 1) == 1


def test_short_runs_shorten_their_schedules() -> None:
    assert [TrainConfig(iterations=n).shortened(500) for n in (30_000, 7000, 700, 1)] == [500, 500, 50, 1]
