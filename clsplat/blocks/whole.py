"""A training in blocks: the coarse run, the jobs of the blocks, and the scene that their results make."""

import json
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.blocks.block import Progress, log_of, result_of, train_block
from clsplat.blocks.jobs import digest_of, make_job, read_job
from clsplat.blocks.masks import write_masks
from clsplat.blocks.partition import Block
from clsplat.blocks.parts import read_index, read_part, read_scene, write_index
from clsplat.blocks.plan import Plan, make_plan
from clsplat.blocks.points import sparse_start
from clsplat.blocks.settings import (
    COARSE_FACTOR,
    block_config,
    check_blocks,
    coarse_config,
    one_fits,
    refining_config,
)
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.errors import InputError
from clsplat.formats import save_gaussians
from clsplat.formats.ply import save_ply_parts
from clsplat.formats.ply_parts import PlyParts
from clsplat.gaussians import Gaussians
from clsplat.inputs import Photo, photos_of
from clsplat.renderer import Renderer
from clsplat.resuming import CHECKPOINT
from clsplat.run_log import LOG
from clsplat.scene import Scene, in_turn
from clsplat.show.training_curve import read_log
from clsplat.training.checkpoint import without_free
from clsplat.training.loop import train
from clsplat.training.moving_files import load_masks
from clsplat.training.sky_start import beyond, may_have_sky

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
) -> tuple[list[Path], Plan | None]:
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
    jobs : list of Path
        Those of the first trainings, in the order of the blocks; empty if one block is enough.
    plan : Plan or None
        None if one block is enough.

    Raises
    ------
    InputError
        If the configuration cannot train blocks, or they do not fit the memory.
    """
    check_blocks(config)
    if one_fits(scene, config, device):
        tell(f"blocks: one is enough for {config.max_gaussians} Gaussians")
        return [], None
    folder = out / BLOCKS
    folder.mkdir(parents=True, exist_ok=True)
    names, seconds = _coarse(scene, config, device, folder, watch)
    photos = _read_photos(scene)
    coarse = read_scene(folder / names["far"], (config.init.sh_degree + 1) ** 2)
    sky = sum(part.rows for part in read_index(folder / names["sky"])) if names["sky"] else 0
    renderer = Renderer(device, config.render, BACKGROUNDS[config.data.background])
    plan = make_plan(coarse, scene, config, renderer, sky)
    if len(plan.blocks) == 1:
        tell(f"blocks: one is enough for about {plan.total} Gaussians")
        return [], None
    tell(plan.describe(config, scene, seconds * COARSE_FACTOR**2))
    jobs = []
    for block in plan.blocks:
        job = make_job(data.resolve(), names, block, scene, photos, block_config(config, scene, block))
        if start := sparse_start(scene, coarse.means, block, config):
            job = replace(job, points=_written(start, "points", folder, config))
        jobs.append(job.write(folder))
    return jobs, plan


def _written(gaussians: Gaussians, name: str, folder: Path, config: TrainConfig) -> str:
    """Write Gaussians into a folder, in a file of a name and their digest, and return the name of their index."""
    digest = digest_of(*(array.tobytes() for array in gaussians.arrays().values()))
    file = folder / f"{name}-{digest}.ply"
    if not file.exists():
        save_gaussians(file, gaussians, config.render.mode)
    return write_index([file]).name


def plan_refinement(
    latest: list[Path], blocks: list[Block], length: float, scene: Scene, config: TrainConfig, data: Path
) -> list[Path]:
    """Write the jobs of trainings in which each block has the trained ones around it.

    In the first trainings each block is surrounded by the coarse scene. Together, the blocks are therefore worse than
    a scene that has been trained as a whole.

    Parameters
    ----------
    latest : list of Path
        The jobs of the latest trainings, all of which have results.
    blocks : list of Block
        Those of a cut of the plan: not that of the latest trainings, whose borders need mending most.
    length : float
        Iterations, as a fraction of those of the first trainings.
    scene : Scene
    config : TrainConfig
    data : Path
        All as given to `plan_blocks`.

    Returns
    -------
    list of Path
        The files of the jobs, in the order of the blocks.
    """
    folder, index = latest[0].parent, write_index([result_of(job) for job in latest])
    counts = np.zeros(len(blocks), int)
    for part in read_index(index):
        means = read_part(folder, part).means
        counts += [block.wide.contains(means).sum() for block in blocks]
    photos, before, refined = _read_photos(scene), read_job(latest[0]), []
    names = {"far": before.far, "sky": before.sky, "moving": before.moving}
    for block, count in zip(blocks, counts.tolist(), strict=True):
        settings = refining_config(config, scene, block, count, length)
        job = make_job(data.resolve(), names, block, scene, photos, settings)
        refined.append(replace(job, scene=index.name, near=block.near).write(folder))
    return refined


def _read_photos(scene: Scene) -> dict[str, Photo]:
    """The training photos with their digests. Those that stream are read, if the coarse run has not read them."""
    photos = photos_of(scene.train, scene.offset)
    if all(photo.pixels for photo in photos.values()):
        return photos
    for _ in in_turn(view for view in scene.train if not photos[view.name].pixels):
        pass  # reading a photo makes its digest known
    return photos_of(scene.train, scene.offset)


def _coarse(
    scene: Scene, config: TrainConfig, device: "Device", folder: Path, watch: Watch
) -> tuple[dict[str, str], float]:
    """Train the coarse scene, unless it exists.

    Returns the names of its index, "far", and of what is empty if there is none: the index of its sky, "sky", and the
    masks of what moves, "moving"; and the seconds that an iteration took.

    Photos that stream have not been read before. The run is then named by their names and cameras alone, and the
    record holds a digest of their pixels.
    """
    photos = json.dumps(photos_of(scene.train, scene.offset))
    settings = coarse_config(config, scene, device)
    bound = json.dumps(asdict(without_free(settings)), sort_keys=True)
    gains = json.dumps({name: factors.tolist() for name, factors in scene.gains.items()})
    points = scene.points.tobytes(), scene.colors.tobytes()
    digest = digest_of(bound.encode(), photos.encode(), gains.encode(), *points)
    done, work = folder / f"coarse-{digest}.json", folder / f"coarse-{digest}"
    if not done.exists():
        with watch("coarse run", settings) as progress:
            resume = (work / CHECKPOINT).exists()
            gaussians = train(scene, settings, work, device, resume=resume, progress=progress)
        seconds = read_log(work / LOG)[-1]["seconds"] / settings.iterations
        ground, sky = _parted(gaussians, scene, settings)
        names = {
            "far": _written(ground, "coarse", folder, settings),
            "sky": _written(sky, "sky", folder, settings) if len(sky) else "",
            "moving": write_masks(load_masks(work), folder),
        }
        with replacing(done) as file:
            file.write(json.dumps({"names": names, "seconds": seconds, "photos": _digest(scene)}).encode())
        shutil.rmtree(work, ignore_errors=True)
    record = json.loads(done.read_text())
    if record.get("photos", _digest(scene)) != _digest(scene):
        raise InputError(
            f"{done}: expected the photos of the coarse run, found other pixels or masks; start a new run in another "
            "folder"
        )
    return record["names"], record["seconds"]


def _parted(gaussians: Gaussians, scene: Scene, config: TrainConfig) -> tuple[Gaussians, Gaussians]:
    """Part a coarse scene into what blocks train, and the sky.

    All photos show the sky. It belongs to no block: to train it, a block would need all of them.
    """
    sky = beyond(gaussians, scene) if may_have_sky(scene, config) else np.zeros(len(gaussians), bool)
    if sky.all():
        sky[:] = False
    return gaussians.take(~sky), gaussians.take(sky)


def _digest(scene: Scene) -> str:
    return digest_of(json.dumps(_read_photos(scene)).encode())


def unfinished(jobs: list[Path]) -> list[Path]:
    """The jobs that have no result."""
    return [job for job in jobs if not result_of(job).exists()]


def run_here(jobs: list[Path], scene: Scene, device: "Device", watch: Watch) -> None:
    """Train the blocks that have no result one after the other on a device."""
    for number, job in enumerate(jobs, 1):
        if not result_of(job).exists():
            with watch(f"block {number} of {len(jobs)}", read_job(job).config) as progress:
                train_block(job, scene.train, device, progress)


def files_of(jobs: list[Path]) -> list[Path]:
    """The files of a scene: the results of its blocks in their order, whoever computed them, and the sky."""
    sky = read_job(jobs[0]).sky
    parts = read_index(jobs[0].with_name(sky)) if sky else []
    return [*map(result_of, jobs), *(jobs[0].with_name(name) for name in dict.fromkeys(part.file for part in parts))]


def merge(files: list[Path], path: Path, offset: NDArray[np.float64] | None = None) -> int:
    """Join PLYs in their order.

    A part of a file is in memory at a time, so that the memory does not grow with the scene.

    Parameters
    ----------
    files : list of Path
        At least one, as `files_of` returns them.
    path : Path
        The file to write, whole or not at all: in the scene's coordinates, with the highest degree of spherical
        harmonics that a file has.
    offset : (3,) array, optional
        What was subtracted from the world's coordinates, in world units.

    Returns
    -------
    int
        The number of Gaussians.

    Raises
    ------
    InputError
        If a file cannot be read or written.
    """
    opened = [PlyParts(file) for file in files]
    count, most = sum(rows.count for rows in opened), max(rows.coefficients for rows in opened)
    parts = (part for rows in opened for _, part in rows.chunks())
    save_ply_parts(path, parts, count, most, opened[0].mode, offset)
    return count


def write_log(out: Path, jobs: list[Path], last: dict[str, Any]) -> None:
    """Write the log of a run: those of the blocks one after the other, and a last record.

    Iterations and seconds continue from block to block; `block` counts blocks from 1. The last record is about the
    whole scene; `last` has only its measurements.
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
