"""The optimiser's moments follow their rows; the schedules at their ends."""

import numpy as np
import pytest

from clsplat.config import OptimConfig, TrainConfig
from clsplat.testing import synthetic_scene
from clsplat.training.optimizer import Moments, adam_settings, sh_degree_at

CONFIG = OptimConfig()


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
    first, last = adam_settings(1, 0.0, 3.0, CONFIG, 3), adam_settings(1000, 1.0, 3.0, CONFIG, 2)
    assert (first.iteration, last.iteration) == (1, 1000)
    assert first.rates["means"] == pytest.approx(3 * CONFIG.means_lr)
    assert last.rates["means"] == pytest.approx(3 * CONFIG.means_lr_final)
    assert [sh_degree_at(i, 1000, 3) for i in (1, 1000, 1001, 3001, 9999)] == [0, 0, 1, 3, 3]
    assert sh_degree_at(9999, 1000, 1) == 1


def test_short_runs_shorten_their_schedules() -> None:
    assert [TrainConfig(iterations=n).shortened(500) for n in (30_000, 7000, 700, 1)] == [500, 500, 50, 1]
