"""Training in blocks from the command line: its progress, its clusters, and the command `block`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from clsplat.commands.console import say
from clsplat.commands.progress import Progress

if TYPE_CHECKING:
    from clsplat.config import TrainConfig
    from clsplat.gaussians import Gaussians
    from clsplat.renderer import Renderer
    from clsplat.scene import Scene


def train_in_blocks(
    scene: "Scene", config: "TrainConfig", renderer: "Renderer", data: Path, out: Path
) -> "Gaussians | None":
    """Train the blocks of a scene and merge them; None if one block is enough."""
    from clsplat.blocks.whole import merge, plan_blocks, run_here, write_log
    from clsplat.evaluate import mean_metrics

    @contextmanager
    def watch(name: str, settings: "TrainConfig") -> Iterator[Callable[[dict[str, Any]], None]]:
        say(f"{name}: {settings.iterations} iterations")
        progress = Progress(scene, settings, renderer, out, None, lambda: None)
        with progress.watching():
            yield progress.after

    assert renderer.device
    jobs = plan_blocks(scene, config, renderer.device, data, out, watch, say)
    if not jobs:
        return None
    run_here(jobs, scene, renderer.device, watch)
    gaussians = merge(jobs)
    scores = mean_metrics(gaussians, scene.test, renderer) if scene.test else {}
    write_log(out, jobs, {"num_gaussians": len(gaussians)} | scores)
    return gaussians


@dataclass(frozen=True)
class Block:
    """Train one block of a scene, as `train --print-jobs` lists them."""

    job: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="JOB")]
    """File that describes the block; the coarse scene is beside it."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.blocks.block import train_block

        say(f"{train_block(self.job)}: done")
