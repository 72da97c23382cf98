"""Blocks of a small scene on disk, which train within a second each."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from small_run import with_strategy

from clsplat.blocks.partition import Block
from clsplat.blocks.plan import Plan
from clsplat.blocks.whole import plan_blocks, plan_refinement
from clsplat.config import FewViewsConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.scene import Scene
from clsplat.training.preparation import prepare

CONFIG = replace(with_strategy("error"), max_gaussians=240, iterations=40, few=FewViewsConfig(below=8))


@contextmanager
def unseen(name: str, config: TrainConfig) -> Iterator[Callable[[dict[str, Any]], None]]:
    yield lambda record: None


@dataclass
class Planned:
    """A scene, its configuration, the plan of its blocks, and the jobs of their first trainings."""

    data: Path
    scene: Scene
    config: TrainConfig
    jobs: list[Path]
    plan: Plan

    def again(self, blocks: list[Block] | None = None) -> list[Path]:
        """The jobs of second trainings, of the plan's blocks or of others."""
        chosen = self.plan.cut(1) if blocks is None else blocks
        return plan_refinement(self.jobs, chosen, 0.5, self.scene, self.config, self.data)


def plan(dataset: Path, device: Device, out: Path, blocks: int) -> Planned:
    """Plan blocks from sparse points at random places."""
    config = replace(CONFIG, blocks=blocks, init=replace(CONFIG.init, triangulate=False))
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.6, 0.6, (200, 3)), rng.integers(0, 256, (200, 3), np.uint8)
    scene = replace(load_scene(dataset, config.data), points=points[0], colors=points[1])
    scene, config = prepare(dataset, config, device, scene=scene)
    jobs, found = plan_blocks(scene, config, device, dataset, out, unseen, lambda text: None)
    assert found
    return Planned(dataset, scene, config, jobs, found)
