"""Settings for the tests that run over all strategies."""

from dataclasses import replace
from typing import Any

from clsplat.config import TrainConfig
from clsplat.training.densify import STRATEGIES


def with_rounds(config: TrainConfig, **settings: Any) -> TrainConfig:
    """Change settings that every strategy has: start, stop_fraction, every. They are in the group with its name."""
    return replace(config, **{name: replace(getattr(config, name), **settings) for name in STRATEGIES})
