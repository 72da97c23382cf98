"""A training in blocks: the coarse run, the jobs of the blocks, and the scene that their results make."""

import json
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.atomic import replacing
from clsplat.blocks.block import Progress, log_of, read_coarse, result_of, train_block
from clsplat.blocks.jobs import digest_of, make_job, read_job
from clsplat.blocks.plan import COARSE_FACTOR, block_config, check_blocks, coarse_config, make_plan, one_fits
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.scene import Scene
from clsplat.show.training_curve import read_log
from clsplat.training.checkpoint import CHECKPOINT, FREE
from clsplat.training.inputs import photos_of
from clsplat.training.loop import train
from clsplat.training.recorder import LOG

if TYPE_CHECKING:
    from clsplat.device import Device

BLOCKS = "blocks"
"""Name of the folder, in that of a run, with the jobs and results of its blocks."""

Watch = Callable[[str, TrainConfig], AbstractContextManager[Progress]]
"""Shows the progress of a training, by its name and configuration."""


def plan_blocks(
    scene: Scene,
    config: TrainConfig,
    device: "Device",
    data: Path,
    out: Path,
    watch: Watch,
    tell: Callable[[str], None],
) -> list[Path]:
    """Train the coarse scene, cut it into blocks, and write a job for each.

    What an interrupted run has finished is not done again.

    Parameters
    ----------
    scene : Scene
    config : TrainConfig
        Both as `clsplat.training.preparation.prepare` returns them.
    device : Device
    data : Path
        The dataset, from which other processes read the photos.
    out : Path
        Folder of the run.
    watch : callable
    tell : callable
        Called with a sentence about each step.

    Returns
    -------
    list of Path
        The files of the jobs, in the order of the blocks; empty if one block is enough.

    Raises
    ------
    InputError
        If the configuration cannot train blocks, or they do not fit the memory.
    """
    check_blocks(config)
    if one_fits(scene, config, device):
        tell(f"blocks: one is enough for {config.max_gaussians} Gaussians")
        return []
    folder = out / BLOCKS
    folder.mkdir(parents=True, exist_ok=True)
    photos = photos_of(scene.train, scene.offset)
    file, seconds = _coarse(scene, config, device, folder, json.dumps(photos), watch)
    coarse = read_coarse(file, config)
    renderer = Renderer(device, config.render, BACKGROUNDS[config.data.background])
    plan = make_plan(coarse, scene, config, renderer)
    if len(plan.blocks) == 1:
        tell(f"blocks: one is enough for about {plan.total} Gaussians")
        return []
    tell(plan.describe(config, scene, seconds * COARSE_FACTOR**2))
    jobs = []
    for block in plan.blocks:
        views = [scene.train[i] for i in block.photos]
        settings = block_config(config, scene, block)
        jobs.append(make_job(data.resolve(), file.name, block.box, block.wide, views, photos, settings).write(folder))
    return jobs


def _coarse(
    scene: Scene, config: TrainConfig, device: "Device", folder: Path, photos: str, watch: Watch
) -> tuple[Path, float]:
    """Train the coarse scene, unless it exists. Returns its file and the seconds that an iteration took."""
    settings = coarse_config(config, scene, device)
    bound = {name: value for name, value in asdict(settings).items() if name not in FREE}
    digest = digest_of(json.dumps(bound, sort_keys=True).encode(), photos.encode(), scene.points.tobytes())
    done, work = folder / f"coarse-{digest}.json", folder / f"coarse-{digest}"
    if not done.exists():
        with watch("coarse run", settings) as progress:
            resume = (work / CHECKPOINT).exists()
            gaussians = train(scene, settings, work, device, resume=resume, progress=progress)
        save_gaussians(folder / "coarse.ply", gaussians, settings.render.mode)
        name = f"{digest_of((folder / 'coarse.ply').read_bytes())}.ply"
        (folder / "coarse.ply").replace(folder / name)
        log = [json.loads(line) for line in (work / LOG).read_text().splitlines()]
        record = {"scene": name, "log": log}
        with replacing(done) as file:
            file.write(json.dumps(record).encode())
        shutil.rmtree(work, ignore_errors=True)
    record = json.loads(done.read_text())
    return folder / record["scene"], record["log"][-1]["seconds"] / settings.iterations


def run_here(jobs: list[Path], scene: Scene, device: "Device", watch: Watch) -> None:
    """Train the blocks that have no result one after the other on a device."""
    for number, job in enumerate(jobs, 1):
        if not result_of(job).exists():
            with watch(f"block {number} of {len(jobs)}", read_job(job).config) as progress:
                train_block(job, scene.train, device, progress)


def merge(jobs: list[Path]) -> Gaussians:
    """Join the results of blocks in their order, whoever computed them.

    Returns
    -------
    Gaussians
        In the scene's coordinates, on the host, with the highest degree of spherical harmonics that a block has.

    Raises
    ------
    InputError
        If a result cannot be read.
    """
    parts = [load_gaussians(result_of(job))[0] for job in jobs]
    most = max(part.sh.shape[1] for part in parts)
    for part in parts:
        part.sh = np.pad(part.sh, ((0, 0), (0, most - part.sh.shape[1]), (0, 0)))
    return Gaussians.concatenate(parts)


def write_log(out: Path, jobs: list[Path], last: dict[str, Any]) -> None:
    """Write the log of a run: those of the blocks one after the other, and a last record.

    Iterations and seconds go on from block to block; `block` counts blocks from 1. The last record, about the whole
    scene, needs only what is measured in it.
    """
    lines: list[dict[str, Any]] = []
    iteration, seconds = 0, 0.0
    for number, job in enumerate(jobs, 1):
        records = read_log(log_of(job))
        for record in records:
            moved = {"iteration": iteration + record["iteration"], "seconds": seconds + record["seconds"]}
            lines.append(record | moved | {"block": number})
        iteration, seconds = iteration + records[-1]["iteration"], seconds + records[-1]["seconds"]
    lines.append({"iteration": iteration, "seconds": seconds} | last)
    with replacing(out / LOG) as file:
        file.writelines(f"{json.dumps(line)}\n".encode() for line in lines)
