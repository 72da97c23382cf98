"""Training in blocks from the command line: its progress, its clusters, and the command `block`."""

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from clsplat.commands.console import say
from clsplat.commands.options import ClusterOptions
from clsplat.commands.progress import Progress
from clsplat.commands.run_folders import SCENE

if TYPE_CHECKING:
    from clsplat.blocks.stored import StoredScene
    from clsplat.blocks.whole import Watch
    from clsplat.config import TrainConfig
    from clsplat.device import Device
    from clsplat.renderer import Renderer
    from clsplat.scene import Scene


def train_in_blocks(
    scene: "Scene", config: "TrainConfig", renderer: "Renderer", data: Path, out: Path, where: ClusterOptions
) -> "StoredScene | None":
    """Train the blocks of a scene and merge them into the file of a run; None if one block is enough.

    Raises
    ------
    JobsPrinted
        If `where.print_jobs` is set, and blocks have to be trained.
    """
    from clsplat.blocks.jobs import read_job
    from clsplat.blocks.masks import masks_of
    from clsplat.blocks.settings import REFINING_LENGTHS
    from clsplat.blocks.stored import StoredScene
    from clsplat.blocks.whole import files_of, merge, plan_blocks, plan_refinement, write_log
    from clsplat.evaluate import mean_metrics
    from clsplat.training.moving_files import save_masks

    @contextmanager
    def watch(name: str, settings: "TrainConfig") -> Iterator[Callable[[dict[str, Any]], None]]:
        say(f"{name}: {settings.iterations} iterations")
        progress = Progress(scene, settings, renderer, out, None, lambda: None)
        with progress.watching():
            yield progress.after

    assert renderer.device
    first, plan = plan_blocks(scene, config, renderer.device, data, out, watch, say)
    if plan is None:
        return None
    _run(first, scene, renderer.device, watch, where)
    trained = [first]
    for training, length in enumerate(REFINING_LENGTHS, 1):
        trained.append(plan_refinement(trained[-1], plan.cut(training), length, scene, config, data))
        _run(trained[-1], scene, renderer.device, watch, where)
    merge(files_of(trained[-1]), out / SCENE, scene.offset)
    save_masks(out, masks_of(first[0], read_job(first[0])))
    gaussians = StoredScene(out / SCENE)
    scores = mean_metrics(gaussians, scene.test, renderer) if scene.test else {}
    write_log(out, list(chain(*trained)), {"num_gaussians": len(gaussians)} | scores)
    return gaussians


class JobsPrinted(Exception):
    """The commands that train blocks have been printed, and are left to others."""


def _run(jobs: list[Path], scene: "Scene", device: "Device", watch: "Watch", where: ClusterOptions) -> None:
    """Train the blocks that have no result, where the options say."""
    from clsplat.blocks.local import devices_like, run_on_devices
    from clsplat.blocks.whole import run_here, unfinished

    if where.print_jobs and unfinished(jobs):
        for job in unfinished(jobs):
            print(shlex.join(["clsplat", "block", str(job.resolve())]))
        raise JobsPrinted
    if where.scheduler is not None:
        from clsplat.blocks.cluster import run_on_cluster

        run_on_cluster(where.scheduler, jobs, scene.train, say)
    elif len(alike := devices_like(device)) > 1:
        say(f"blocks: {len(alike)} devices of this name train one each")
        run_on_devices(jobs, alike, say)
    else:
        run_here(jobs, scene, device, watch)


@dataclass(frozen=True)
class Block:
    """Train one block of a scene, as `train --print-jobs` lists them."""

    job: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="JOB")]
    """File that describes the block; the coarse scene is beside it."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.blocks.block import train_block

        say(f"{train_block(self.job)}: done")
