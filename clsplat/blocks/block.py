"""Training of a block: a function of files, whose result is a file that exists whole or not at all."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.blocks.jobs import Job, read_job
from clsplat.blocks.masks import masks_of
from clsplat.blocks.partition import EVERYWHERE
from clsplat.blocks.parts import Part, bounds_of, read_index, read_part
from clsplat.blocks.sight import Bounds, looking_at, seen
from clsplat.blocks.survey import seen_by_block
from clsplat.camera import Camera
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.dataset import load_photos, read_depth_maps
from clsplat.errors import ClsplatError
from clsplat.formats import save_gaussians
from clsplat.formats.ply import with_coefficients
from clsplat.gaussians import Gaussians
from clsplat.inputs import Inputs
from clsplat.pruning.prices import without_invisible
from clsplat.renderer import Renderer
from clsplat.resuming import CHECKPOINT
from clsplat.run_log import LOG
from clsplat.scene import Scene, View
from clsplat.streaming import Files, photo_budget
from clsplat.training.checkpoint import load_state
from clsplat.training.loop import complete
from clsplat.training.memory import Footprint
from clsplat.training.moving import still
from clsplat.training.preparation import open_device, photo_memory
from clsplat.training.run_folder import held
from clsplat.training.session import Training
from clsplat.training.state import initial_state

if TYPE_CHECKING:
    from clsplat.device import Device

SEEN = "photos"
"""Folder, in that of a block's training, of the photos as the block sees them, where they do not fit the memory."""

Progress = Callable[[dict[str, Any]], None]
"""Called after every iteration, as the argument of `clsplat.training.loop.train`."""


def result_of(job_file: Path) -> Path:
    """The file of a block's result, beside that of its job."""
    return job_file.with_suffix(".ply")


def log_of(job_file: Path) -> Path:
    """The file of a block's log, beside that of its job."""
    return job_file.with_suffix(".jsonl")


def train_block(
    job_file: Path | str,
    loaded: list[View] | None = None,
    device: "Device | None" = None,
    progress: Progress = lambda record: None,
    beside: int = 1,
) -> Path:
    """Train a block, unless its result exists; continue where an interrupted run has left a checkpoint.

    The Gaussians of the scene in the block and its margin train; the sky and the others that its photos show are
    drawn and stay as they are. The result is what lies in the block after the training. A block without a margin
    keeps all that it has trained, since nothing else trains what has left it.

    Parameters
    ----------
    job_file : Path or str
        As `clsplat.blocks.jobs.Job.write` wrote it, with the scenes that it names beside it.
    loaded : list of View, optional
        Photos of the dataset, those of the block among them. Default: these are read.
    device : Device, optional
        Default: the one that the job's configuration describes.
    progress : callable
    beside : int
        Processes that train blocks on this machine, whose memory for photos they share.

    Returns
    -------
    Path
        The result, `result_of` the job; its log is `log_of` it.

    Raises
    ------
    InputError
        If a file is missing or is not the one that the job was made with, or another process trains the block.
    ClsplatError
        If the training fails, or leaves nothing in the block.
    """
    job_file = Path(job_file)
    result, work = result_of(job_file), job_file.with_suffix("")
    if result.exists():
        return result
    job = read_job(job_file)
    start = _start(job_file, job)
    views = still(job.views(_loaded(job, beside) if loaded is None else loaded), masks_of(job_file, job))
    device = device or open_device(job.config)
    with held(work):
        if not result.exists():
            gaussians = _trained(job, start, views, device, work, progress, beside)
            with replacing(log_of(job_file)) as file:
                file.write((work / LOG).read_bytes())
            save_gaussians(result, gaussians, job.config.render.mode)
    shutil.rmtree(work, ignore_errors=True)
    return result


def _loaded(job: Job, beside: int) -> list[View]:
    """The photos of a block, with their depth maps if it has them."""
    memory = photo_memory(job.config) or photo_budget(None)
    views = load_photos(job.data, job.config.data, job.photos, None if memory is None else memory // beside)
    return read_depth_maps(views, job.data, job.config.data) if job.depths else views


def needed_parts(job_file: Path, job: Job) -> Iterator[tuple[str, Part, list[Camera]]]:
    """Yield the parts of scenes that a block trains or its photos may show, in their order: the field of the job that
    names the scene; the part; and the cameras that may show it.

    Raises
    ------
    InputError
        If an index cannot be read or has been changed.
    """
    cameras = job.posed()
    used = {"scene": True, "far": job.near != EVERYWHERE, "sky": bool(job.sky)}
    for scene in compress(used, used.values()):
        parts = read_index(job_file.with_name(getattr(job, scene)))
        bounds = bounds_of(parts)
        looking = looking_at(cameras, bounds, job.config.render)
        wanted = looking.any(axis=0)
        if scene != "sky":
            wanted |= job.wide.meets(bounds.low, bounds.high)
        if scene == "scene":
            wanted &= job.near.meets(bounds.low, bounds.high)
        yield from ((scene, parts[k], [*compress(cameras, looking[:, k])]) for k in np.flatnonzero(wanted))


def points_of(job_file: Path, job: Job) -> list[Part]:
    """The parts of the Gaussians at sparse points that a block trains, too.

    Raises
    ------
    InputError
        If their index cannot be read or has been changed.
    """
    return read_index(job_file.with_name(job.points)) if job.points else []


class _Start(NamedTuple):
    """Where a block starts: the Gaussians in it and those around it that its photos may show; which of these the
    block trains, (N,); and those at sparse points, which it trains, too."""

    gaussians: Gaussians
    trains: NDArray[np.bool_]
    points: list[Gaussians]


def _start(job_file: Path, job: Job) -> _Start:
    def read(part: Part) -> Gaussians:
        return with_coefficients(read_part(job_file.parent, part), (job.config.init.sh_degree + 1) ** 2)

    found, own = [], []
    for scene, part, cameras in needed_parts(job_file, job):
        gaussians = read(part)
        if scene != "sky":
            gaussians = gaussians.take(job.near.contains(gaussians.means) == (scene == "scene"))
        trains = job.wide.contains(gaussians.means) & (scene != "sky")
        rows = trains | seen(cameras, Bounds.of(gaussians), job.config.render)
        found.append(gaussians.take(rows))
        own.append(trains[rows])
    points = [read(part) for part in points_of(job_file, job)]
    return _Start(Gaussians.concatenate(found), np.concatenate(own), points)


def _scene(views: list[View]) -> Scene:
    """Photos of a block, as a scene without points."""
    return Scene(views, [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def _seen(
    device: "Device",
    start: _Start,
    views: list[View],
    config: TrainConfig,
    folder: Path,
    beside: int,
) -> tuple[list[View], NDArray[np.bool_]]:
    """The photos as the block should see them, in files of a folder, if the views stream; and what they show."""
    renderer = Renderer(device, config.render, BACKGROUNDS[config.data.background])
    most = Footprint.of(_scene(views), config, device).most_drawn(device.memory_limit)
    budget = photo_budget(photo_memory(config))
    if budget is None or not any(view.ahead for view in views):
        return seen_by_block(renderer, start.gaussians, start.trains, views, most=most)
    budget //= beside
    folder.mkdir(parents=True, exist_ok=True)
    files = Files(folder)
    _, shown = seen_by_block(renderer, start.gaussians, start.trains, views, files.write, most)
    streamed = files.views(views, budget)
    return [made.with_depth(view.depth) for made, view in zip(streamed, views, strict=True)], shown


def _trained(
    job: Job,
    start: _Start,
    views: list[View],
    device: "Device",
    work: Path,
    progress: Progress,
    beside: int,
) -> Gaussians:
    """Train the block in a folder that is held, and return what it keeps."""
    config = job.config
    device.buffers.forget()  # another block's sizes
    seen, shown = _seen(device, start, views, job.config, work / SEEN, beside)
    device.buffers.forget()  # those of all that was drawn; less of it trains
    scene = _scene(seen)
    inputs = Inputs.of(scene, device)
    if (work / CHECKPOINT).exists():
        state = load_state(work / CHECKPOINT, scene.extent, config, inputs)
    else:
        first = Gaussians.concatenate([start.gaussians.take(start.trains), *start.points])
        state = replace(initial_state(scene, config, first), inputs=inputs)
    state.inputs.demand(scene)
    training = Training(scene, config, device, state, start.gaussians.take(shown & ~start.trains))
    gaussians = complete(training, work, progress=progress)
    kept = gaussians if job.wide == job.box else gaussians.take(job.box.contains(gaussians.means))
    if not len(kept):
        raise ClsplatError(
            f"{work.name}: expected Gaussians in the block after its training, found none; use fewer --blocks"
        )
    return without_invisible(kept)
