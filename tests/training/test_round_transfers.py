"""What a round of densification brings to the host and back: bytes per Gaussian and per pixel, counted."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pyopencl.array
import pytest
from every_strategy import with_rounds
from test_memory import make_scene

from clsplat.config import AdcConfig, InitConfig, OptimConfig, TrainConfig
from clsplat.device import Device
from clsplat.training.densify import STRATEGIES
from clsplat.training.loop import train
from clsplat.training.session import Training

REAL = 4
GEOMETRY = 11 * REAL
"""All parameters but the spherical harmonics, which have 48 values more."""

ROWS = 2 * REAL
"""The rows that harmonics and moments continue."""

STATISTICS = {"error": 1 * REAL, "adc": 2 * REAL, "mcmc": 0}
SURVEYS = {"error": 5 * 2 * REAL}
"""Sums of twice the precision, whatever the number of photos."""

WIDTH, HEIGHT, VIEWS = 40, 32, 3
PIXEL = 4
"""A photo and a mask; the render and its errors stay on the device."""


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_only_what_an_edit_changes_crosses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, strategy: str) -> None:
    """At commit e9b3102 all parameters crossed, and the rows ten times: 236 B down and 276 B up per Gaussian, beside
    the statistics; `error` brought 40 B more for each photo, 400 B in a round, and 41 B for each pixel."""
    rounds: list[tuple[int, int]] = []
    rows, pixels = {"down": 0, "up": 0}, {"down": 0, "up": 0}
    densify, get, put = Training.densify, pyopencl.array.Array.get, pyopencl.array.Array.set
    sizes: set[int] = set()

    def counted(array: Any, way: str) -> None:
        (rows if array.shape[0] in sizes else pixels)[way] += array.nbytes

    def read(array: Any, *arguments: Any, **options: Any) -> Any:
        counted(array, "down")
        return get(array, *arguments, **options)

    def written(array: Any, *arguments: Any, **options: Any) -> None:
        counted(array, "up")
        put(array, *arguments, **options)

    def watched(training: Training, cap: int) -> None:
        n = len(training.state.gaussians)
        sizes.update(range(n // 2, 2 * n))  # of arrays with a row per Gaussian; the others are images
        for crossed in (rows, pixels):
            crossed.update(down=0, up=0)
        densify(training, cap)
        sizes.clear()
        m = len(training.state.gaussians)
        rounds.append((n, m))
        statistics = STATISTICS[strategy]
        assert rows["down"] == n * (GEOMETRY + statistics + SURVEYS.get(strategy, 0))
        assert rows["up"] == m * (GEOMETRY + statistics + ROWS)
        surveyed = PIXEL * WIDTH * HEIGHT * VIEWS if strategy in SURVEYS else 0
        assert pixels == {"down": 0, "up": surveyed}

    monkeypatch.setattr(Training, "densify", watched)
    monkeypatch.setattr(pyopencl.array.Array, "get", read)
    monkeypatch.setattr(pyopencl.array.Array, "set", written)
    config = TrainConfig(
        strategy=strategy,
        size="fixed",
        max_gaussians=700,
        iterations=20,
        eval_every=0,
        init=InitConfig(sh_degree=3),
        optim=OptimConfig(sh_degree_every=1),
        adc=AdcConfig(grad_threshold=1e-6),
    )
    config = with_rounds(config, every=5, start=5, stop_fraction=1)
    config = replace(config, error=replace(config.error, views=VIEWS))
    train(make_scene(500, WIDTH, HEIGHT), config, tmp_path, Device())
    assert len(rounds) >= 2
    assert any(m > n for n, m in rounds)
