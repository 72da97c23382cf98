"""A dataset on disk that trains in blocks within seconds, its coarse scene and its jobs."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from small_run import with_strategy
from test_cli import write_dataset

from clsplat.blocks.whole import plan_blocks
from clsplat.config import FewViewsConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.scene import Scene
from clsplat.training.preparation import prepare

CONFIG = replace(with_strategy("error"), max_gaussians=160, iterations=40, few=FewViewsConfig(below=3))


@contextmanager
def unseen(name: str, config: TrainConfig) -> Iterator[Callable[[dict[str, Any]], None]]:
    yield lambda record: None


@dataclass
class Planned:
    """A scene, its configuration, and the jobs of its blocks."""

    data: Path
    scene: Scene
    config: TrainConfig
    jobs: list[Path]


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_dataset(folder, 13)
    return folder


@pytest.fixture
def planned(dataset: Path, device: Device, tmp_path: Path) -> Planned:
    return plan(dataset, device, tmp_path, 2)


def plan(dataset: Path, device: Device, out: Path, blocks: int) -> Planned:
    """Plan blocks from random points: a start without structure from motion."""
    init = replace(CONFIG.init, triangulate=False, random_points=80)
    config = replace(CONFIG, blocks=blocks, init=init)
    scene, config = prepare(dataset, config, device, scene=load_scene(dataset, config.data))
    return Planned(
        dataset, scene, config, plan_blocks(scene, config, device, dataset, out, unseen, lambda text: None)
    )
