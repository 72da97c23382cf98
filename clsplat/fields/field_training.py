"""The training of a field: iterations, log, checkpoints and evaluations."""

import json
import time
from collections.abc import Callable, Container
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.errors import ClsplatError
from clsplat.fields.field import Field
from clsplat.fields.field_files import MODEL, load_checkpoint, save_checkpoint, save_field
from clsplat.fields.pixels import Pixels
from clsplat.fields.space import Space
from clsplat.randomness import stream
from clsplat.scene import Scene

if TYPE_CHECKING:
    from clsplat.device import Device

CHECKPOINT = "checkpoint.npz"
"""File name of the checkpoint in the folder of a run."""

LOG_EVERY = 10
"""Iterations per line of the log; the loss of a line is their mean."""


def train_field(
    scene: Scene,
    method: type[Field],
    config: TrainConfig,
    out: Path,
    device: "Device",
    *,
    resume: bool = False,
    evaluate: Callable[[Field], dict[str, Any]] | None = None,
    evaluate_after: Container[int] = (),
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
    evaluate : callable, optional
        Called with the field after the iterations in `evaluate_after`; what it returns is logged. Its time does not
        count.
    progress : callable
        Called after every iteration with iteration, iterations, loss and rays. If it raises KeyboardInterrupt, a
        checkpoint is written.

    Returns
    -------
    Field
        With the precision of its file.

    Raises
    ------
    InputError
        If `resume` finds no checkpoint, or one of another method or configuration.
    DeviceError
        If the device's memory, or its limit, is exceeded.
    ClsplatError
        If the loss stops being finite.
    """
    iterations, seconds = config.iterations or method.iterations, 0.0
    if resume:
        field, seconds = load_checkpoint(out / CHECKPOINT, method, config, device)
    else:
        field = method(Space.of(scene.train), device, config.seed)
    pixels = Pixels(scene.train, field.space, BACKGROUNDS[config.data.background])
    log = _Log(out / "log.jsonl", field.iteration)
    started = time.perf_counter() - seconds
    losses: list[float] = []
    try:
        while field.iteration < iterations:
            batch = pixels.draw(stream(config.seed, "pixels of a batch", field.iteration + 1), field.rays)
            losses.append(field.step(batch, field.iteration / iterations))
            iteration = field.iteration
            if not np.isfinite(losses[-1]):
                raise ClsplatError(f"iteration {iteration}: expected a finite loss, found {losses[-1]}")
            record = {
                "iteration": iteration,
                "seconds": time.perf_counter() - started,
                "loss": float(np.mean(losses)),
            }
            before = time.perf_counter()
            if evaluate and iteration in evaluate_after:
                record |= evaluate(field)
            if iteration % LOG_EVERY == 0 or iteration == iterations or len(record) > 3:
                log.append(record)
                losses = []
            progress({"iteration": iteration, "iterations": iterations, "loss": record["loss"], "rays": field.rays})
            started += time.perf_counter() - before
            if iteration % config.checkpoint_every == 0 and iteration < iterations:
                save_checkpoint(out / CHECKPOINT, field, config, time.perf_counter() - started)
    except KeyboardInterrupt:
        save_checkpoint(out / CHECKPOINT, field, config, time.perf_counter() - started)
        raise
    save_checkpoint(out / CHECKPOINT, field, config, time.perf_counter() - started)
    field.finish()
    save_field(out / MODEL, field)
    return field


class _Log:
    """The log of a training; records after the iteration from which it resumes are removed."""

    def __init__(self, path: Path, iteration: int):
        self._path, kept = path, ""
        if iteration and path.exists():
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            kept = "".join(
                line for line in lines if line.endswith("\n") and json.loads(line)["iteration"] <= iteration
            )
        path.write_text(kept, encoding="utf-8")

    def append(self, record: dict[str, Any]) -> None:
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record, allow_nan=False) + "\n")
