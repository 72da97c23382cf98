"""Blocks of a small scene on disk, which train within a second each."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from small_run import with_strategy

from clsplat.blocks.plan import Block
from clsplat.blocks.whole import plan_blocks
from clsplat.config import FewViewsConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.scene import Scene
from clsplat.training.preparation import prepare

CONFIG = replace(with_strategy("error"), max_gaussians=240, iterations=40, few=FewViewsConfig(below=3))


@contextmanager
def unseen(name: str, config: TrainConfig) -> Iterator[Callable[[dict[str, Any]], None]]:
    yield lambda record: None


@dataclass
class Planned:
    """A scene, its configuration, its blocks, and the jobs of their first trainings."""

    data: Path
    scene: Scene
    config: TrainConfig
    jobs: list[Path]
    blocks: list[Block]


def plan(dataset: Path, device: Device, out: Path, blocks: int) -> Planned:
    """Plan blocks from random points: a start without structure from motion."""
    init = replace(CONFIG.init, triangulate=False, random_points=80)
    config = replace(CONFIG, blocks=blocks, init=init)
    scene, config = prepare(dataset, config, device, scene=load_scene(dataset, config.data))
    jobs, cut = plan_blocks(scene, config, device, dataset, out, unseen, lambda text: None)
    return Planned(dataset, scene, config, jobs, cut)
