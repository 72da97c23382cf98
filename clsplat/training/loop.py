"""Training on a scene's photos, from the first Gaussians or a checkpoint to the scene that is saved."""

import time
from collections.abc import Callable, Container
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.config import TrainConfig
from clsplat.dataset.brightness import evened
from clsplat.dataset.near_planes import with_near_planes
from clsplat.dataset.outlines import in_free_space
from clsplat.errors import BuildError, DeviceError, InputError, driver_errors
from clsplat.gaussians import Gaussians
from clsplat.inputs import Inputs
from clsplat.pruning.prices import shown_by_any, without_invisible
from clsplat.renderer import fetch
from clsplat.resuming import CHECKPOINT
from clsplat.run_log import LOG, log_file
from clsplat.scene import Scene
from clsplat.training.autosize.explanation import write_report
from clsplat.training.autosize.reduction import without_useless_bands
from clsplat.training.autosize.search import search_size
from clsplat.training.autosize.validation import split
from clsplat.training.checkpoint import load_state, write_photos
from clsplat.training.dense_start import first_points
from clsplat.training.initialize import initialize
from clsplat.training.moving import still
from clsplat.training.moving_files import save_masks
from clsplat.training.preparation import check_settings, open_device
from clsplat.training.recorder import Recorder
from clsplat.training.run_folder import held
from clsplat.training.run_length import with_length
from clsplat.training.session import Training
from clsplat.training.sky_start import beyond, empty_space, may_have_sky, with_sky
from clsplat.training.state import initial_state, start_config

if TYPE_CHECKING:
    from clsplat.device import Device


def train(
    scene: Scene,
    config: TrainConfig,
    out: Path | str,
    device: "Device | None" = None,
    *,
    resume: bool = False,
    evaluate: Callable[[Gaussians], dict[str, float]] | None = None,
    evaluate_after: Container[int] | None = None,
    progress: Callable[[dict[str, Any]], None] = lambda record: None,
) -> Gaussians:
    """Train Gaussians on a scene's photos.

    Parameters
    ----------
    scene : Scene
    config : TrainConfig
        Both as `clsplat.training.preparation.prepare` returns them, to do what ``clsplat train`` does.
    out : Path or str
        Folder for checkpoint.npz, from which an interrupted run resumes, and log.jsonl, one JSON object per line;
        created if missing.
    device : Device, optional
        Default: the one that `config.device` and `config.memory_limit` describe.
    resume : bool
        Continue from the checkpoint in `out`, to the same bits as a run that was never interrupted.
    evaluate : callable, optional
        Called every `config.eval_every` iterations with the Gaussians, on the device, and at the end with those that
        are returned. Its result is logged. The times in the log do not include it.
    evaluate_after : container of int, optional
        Iterations after which `evaluate` is called instead; not at the end.
    progress : callable
        Called after every iteration with a dict of iteration, loss, num_gaussians and gaussians. These are the
        Gaussians that train, and must not be changed. The times in the log do not include it. If it raises
        KeyboardInterrupt, a checkpoint is written before the run ends.

    Returns
    -------
    Gaussians
        In the scene's coordinates, on the host, without those that no pixel shows.

    Raises
    ------
    InputError
        If a setting is out of range, the scene has no photos to train on, or another process or thread trains into
        the folder. With `resume`, if there is no checkpoint, or it was made with other photos, masks, cameras, points
        or settings.
    DeviceError
        If the device's memory, or its limit, is exceeded.
    ClsplatError
        If the loss stops being finite, or a parameter is not when a checkpoint is due.

    Warns
    -----
    UserWarning
        If the Gaussians stop growing because more would not fit the device's memory, or if a run resumes on another
        device or driver, where its bits differ; or if the last checkpoint cannot be written.
    """
    check(scene, config)
    scene, config = with_near_planes(scene), with_length(config, scene)
    out, device = Path(out), device or open_device(config)
    with held(out):
        inputs, read = Inputs.of(scene, device), scene
        state = load_state(out / CHECKPOINT, scene.extent, config, inputs) if resume else None
        # Another processor may find other gains by rounding: a run keeps its own.
        gains = {name: np.array(factors) for name, factors in (state.inputs if state else inputs).gains.items()}
        scene = evened(replace(scene, gains=gains))
        empty = empty_space(scene, config)
        if not state:
            started = time.perf_counter()
            start = first_points(scene, config, device)
            gaussians = initialize(start, start_config(config), config.seed, config.max_gaussians)
            gaussians = with_sky(gaussians, start, config, plain=bool(empty))
            state = replace(initial_state(scene, config, gaussians), inputs=inputs)
            state.seconds = time.perf_counter() - started
        state.inputs.demand(read)
        training = Training(scene, config, device, state, empty=empty)
        return complete(training, out, evaluate=evaluate, evaluate_after=evaluate_after, progress=progress)


def complete(
    training: Training,
    out: Path,
    *,
    evaluate: Callable[[Gaussians], dict[str, float]] | None = None,
    evaluate_after: Container[int] | None = None,
    progress: Callable[[dict[str, Any]], None] = lambda record: None,
) -> Gaussians:
    """Run a training from its state to its end, with log and checkpoints in a folder that this process holds.

    Parameters, result and errors are those of `train`.
    """
    state, config = training.state, training.config
    log = log_file(out / LOG, min(state.iteration, config.iterations - 1))
    recorder = Recorder(training, out, log, progress, evaluate, evaluate_after)
    _run(training, recorder, out)
    gaussians = finish(training, out)
    recorder.end(gaussians)
    return gaussians


def _run(training: Training, recorder: Recorder, out: Path) -> None:
    last = training.config.iterations
    try:
        with driver_errors():
            if training.state.search:
                search_size(training, recorder.after, recorder.after_fork)
            training.run_until(last, recorder.after)
    except InputError as error:  # a photo that streams, or a checkpoint that cannot be written
        raise InputError(
            f"iteration {min(training.state.iteration + 1, last)}: {error}; the last checkpoint in {out}, if there "
            "is one, is intact: --resume continues from it"
        ) from error
    except DeviceError as error:
        less = "" if isinstance(error, BuildError) else ", and a lower --memory-limit stops growth earlier"
        raise DeviceError(
            f"iteration {training.state.iteration + 1}: {error}; the last checkpoint in {out}, if there is one, "
            f"is intact: --resume continues from it{less}"
        ) from error


def check(scene: Scene, config: TrainConfig) -> None:
    """Raise an InputError if the configuration cannot train the scene."""
    check_settings(config)
    if not scene.train:
        raise InputError("scene: expected at least one photo to train on, found none; lower --test-every")


def finish(training: Training, out: Path) -> Gaussians:
    """Write the reports of a training that has ended, and return its scene."""
    state, scene = training.state, training.scene
    if state.exposures or state.poses:
        write_photos(out / "photos.json", state, scene)
    save_masks(out, state.moving)
    gaussians = fetch(state.shown(training.renderer))
    state.move(None)  # what follows needs the device's memory
    if state.search:
        held = [view.name for view in split(scene.train)[1]]
        write_report(out / "size.json", state.search, len(gaussians), training.config, held)
        views = still(state.corrected(scene.train), state.moving)
        gaussians = without_useless_bands(gaussians, views, training.renderer)
    if state.strategy.leaves_room and training.renderer.backdrop is None:  # other photos may show those of a block
        cameras = [view.camera for view in state.corrected(scene.train)]
        shown = shown_by_any(gaussians, cameras, training.renderer)
        if may_have_sky(scene, training.config):
            shown |= beyond(gaussians, scene)
        shown &= ~in_free_space(gaussians.means, training.empty)
        gaussians = gaussians.take(shown) if shown.any() else gaussians
    return without_invisible(gaussians)
