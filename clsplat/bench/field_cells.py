"""Trainings of radiance fields for `clsplat bench quality`, measured while they run."""

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from clsplat.bench.cells import Cell, Source
from clsplat.bench.measures import TRAINING_PHOTOS, Masks, facts_of, finite, quality_of, sample_iterations
from clsplat.bench.results import Record
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.device import Device
from clsplat.evaluate import mean_metrics_of
from clsplat.fields import METHODS, Field
from clsplat.fields.field_files import MODEL, save_field
from clsplat.fields.field_training import train_field
from clsplat.metrics import psnr, to_uint8
from clsplat.ranges import parse_bytes
from clsplat.scene import Color, Scene, View, evenly_spaced

SAMPLE_EVERY = 3
"""Divisor of the number of evaluations during a training: a field, whose images take seconds, has a third of those of
Gaussians, the last included."""

TIMED_VIEWS = 5
"""Number of held-out views that are rendered for the rate of frames: a field takes seconds for some."""


def source_of(cell: Cell) -> Source:
    """The dataset of a cell; for a field, read so that photos keep their transparency."""
    if cell.method not in METHODS:
        return cell.source
    return replace(cell.source, data=replace(cell.source.data, random_background=True))


def run_field(
    method: type[Field],
    config: TrainConfig,
    scene: Scene,
    evaluator: Device,
    record: Callable[[Record], None],
    rare: Masks | None = None,
) -> Record:
    """Run one training of a field. Arguments and result as for `clsplat.bench.quality.run_cell`.

    The entry spz_bytes is the size of the field's file, and num_gaussians None.
    """
    limit = None if config.memory_limit is None else parse_bytes(config.memory_limit, "--memory-limit")
    device, background = Device(evaluator.cl_device, memory_limit=limit), BACKGROUNDS[config.data.background]
    facts, at = facts_of(scene, rare), sample_iterations(config.iterations)[::-SAMPLE_EVERY]
    clocks = time.perf_counter, time.process_time
    evaluating = np.zeros(2)
    best: float | None = None
    with tempfile.TemporaryDirectory() as folder, tqdm(total=config.iterations, leave=False) as bar:
        out = Path(folder)
        train_field(scene, method, replace(config, iterations=1), out, Device(evaluator.cl_device))  # builds kernels
        started = np.array([clock() for clock in clocks])

        def sample(field: Field) -> Record:
            nonlocal evaluating, best
            now = np.array([clock() for clock in clocks])
            seconds, cpu_seconds = map(float, now - started - evaluating)
            values = facts | {"iteration": field.iteration, "seconds": seconds, "cpu_seconds": cpu_seconds}
            memory = device.memory_peak
            save_field(out / MODEL, field)
            values |= quality_of(_images(field, scene.test, background), scene.test, rare)
            if values["psnr"] is not None:
                best = values["psnr"] if best is None else max(best, values["psnr"])
            values |= {"num_gaussians": None, "spz_bytes": (out / MODEL).stat().st_size, "best": best}
            evaluating += np.array([clock() for clock in clocks]) - now
            return values | {"memory_bytes": memory}

        def evaluate(field: Field) -> dict[str, Any]:
            if field.iteration in at[1:]:
                record(sample(field))
            return {}

        def progress(now: dict[str, Any]) -> None:
            bar.update(now["iteration"] - bar.n)

        field = train_field(scene, method, config, out, device, evaluate=evaluate, progress=progress)
        values = sample(field)
    views = evenly_spaced(scene.train, TRAINING_PHOTOS)
    values |= finite({"train_psnr": mean_metrics_of(_images(field, views, background), views, (psnr,))["psnr"]})
    values |= {"fps": _frames_per_second(field, scene.test, background)}
    record(values)
    return values


def _images(field: Field, views: list[View], background: Color) -> Iterator[NDArray[np.uint8]]:
    for view in views:
        yield to_uint8(field.image(view.camera, background))


def _frames_per_second(field: Field, views: list[View], background: Color) -> float:
    """Reciprocal of the median time of an image, 1/s."""
    seconds = []
    for view in evenly_spaced(views, TIMED_VIEWS):
        started = time.perf_counter()
        field.image(view.camera, background)
        seconds.append(time.perf_counter() - started)
    return 1 / float(np.median(seconds))
