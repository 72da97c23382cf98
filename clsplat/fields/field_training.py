"""The training of a field: iterations, log, checkpoints and evaluations."""

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.errors import ClsplatError, InputError
from clsplat.fields.field import Field
from clsplat.fields.field_files import MODEL, load_checkpoint, save_checkpoint, save_field
from clsplat.fields.pixels import Pixels
from clsplat.fields.space import Space
from clsplat.inputs import Inputs
from clsplat.randomness import stream
from clsplat.resuming import CHECKPOINT
from clsplat.run_log import LOG, LOG_EVERY, log_file
from clsplat.scene import Scene

if TYPE_CHECKING:
    from clsplat.device import Device


def train_field(
    scene: Scene,
    method: type[Field],
    config: TrainConfig,
    out: Path,
    device: "Device",
    *,
    resume: bool = False,
    evaluate: Callable[[Field], dict[str, Any]] = lambda field: {},
    progress: Callable[[dict[str, Any]], None] = lambda record: None,
) -> Field:
    """Train a field on a scene's photos.

    Parameters
    ----------
    scene : Scene
        Loaded with random backgrounds, which keeps the transparency of photos.
    method : type of Field
        One of `clsplat.fields.METHODS`.
    config : TrainConfig
        Its iterations (0: those of the method), seed, background and `checkpoint_every` count.
    out : Path
        Folder for checkpoint.npz, field.npz and log.jsonl; it exists.
    device : Device
    resume : bool
        Continue from the checkpoint in `out`, to the same bits as a training that was never interrupted.
    evaluate : callable
        Called with the field after every iteration. Its result, if any, is logged; the times in the log exclude it.
    progress : callable
        Called after every iteration with iteration, iterations, loss and rays. If it raises KeyboardInterrupt, a
        checkpoint is written. An interrupt at another time, within an iteration, leaves the last checkpoint.

    Returns
    -------
    Field
        With the precision of its file.

    Raises
    ------
    InputError
        If `resume` finds no checkpoint, or one of another method, configuration or dataset.
    DeviceError
        If the device's memory, or its limit, is exceeded.
    ClsplatError
        If the loss stops being finite.

    Warns
    -----
    UserWarning
        If a training resumes on another device, or its last checkpoint cannot be written.
    """
    config = replace(config, iterations=config.iterations or method.iterations)
    inputs = Inputs.of(scene, device)
    seconds, losses = 0.0, list[float]()
    if resume:
        field, seconds, losses = load_checkpoint(out / CHECKPOINT, method, config, inputs, device)
    else:
        field = method(Space.of(scene.train), device, config.seed)
    pixels, clock = Pixels(scene.train, field.space, BACKGROUNDS[config.data.background]), _Clock(seconds)
    log = _Lines(out / LOG, field.iteration, losses)

    def save() -> None:
        save_checkpoint(out / CHECKPOINT, field, config, inputs, clock.seconds, losses)

    while field.iteration < config.iterations:
        loss = _advance(field, pixels, config)
        with clock.stopped():
            now = {"iteration": field.iteration, "seconds": clock.seconds, "loss": loss}
            log.record(now, evaluate(field), last=field.iteration == config.iterations)
            try:
                progress(now | {"iterations": config.iterations, "rays": field.rays})
            except KeyboardInterrupt:
                save()
                raise
            if field.iteration % config.checkpoint_every == 0 and field.iteration < config.iterations:
                save()
    try:
        save()
    except InputError as error:
        warnings.warn(f"{error}; the field is written next, without it", stacklevel=2)
    field.finish()
    save_field(out / MODEL, field)
    return field


def _advance(field: Field, pixels: Pixels, config: TrainConfig) -> float:
    """Take the next step of a field. Returns the loss, which is finite."""
    rng = stream(config.seed, "pixels of a batch", field.iteration + 1)
    loss = field.step(pixels.draw(rng, field.rays), field.iteration / config.iterations)
    if not np.isfinite(loss):
        raise ClsplatError(f"iteration {field.iteration}: expected a finite loss, found {loss}")
    return loss


class _Clock:
    """Training time in seconds, which stands still while it is stopped."""

    def __init__(self, seconds: float):
        self._started, self._stopped_at = time.perf_counter() - seconds, 0.0

    @property
    def seconds(self) -> float:
        return (self._stopped_at or time.perf_counter()) - self._started

    @contextmanager
    def stopped(self) -> Iterator[None]:
        self._stopped_at = time.perf_counter()
        try:
            yield
        finally:
            self._started += time.perf_counter() - self._stopped_at
            self._stopped_at = 0.0


class _Lines:
    """The lines of the log: the mean loss since the last one, and what was found.

    `losses` are those since the last line; `record` adds to the list, and clears it after a line.
    """

    def __init__(self, path: Path, iteration: int, losses: list[float]):
        self._append, self._losses = log_file(path, iteration), losses

    def record(self, now: dict[str, Any], found: dict[str, Any], last: bool) -> None:
        """Write a line every `LOG_EVERY` iterations, after an evaluation and at the end."""
        self._losses.append(now["loss"])
        if now["iteration"] % LOG_EVERY and not found and not last:
            return
        self._append(now | {"loss": float(np.mean(self._losses))} | found)
        self._losses.clear()
