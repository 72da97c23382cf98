"""Quality against time, Gaussians, bytes and memory: trainings by several methods, measured while they run."""

import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from clsplat.bench.captures import captured
from clsplat.bench.cells import Cell, Source, differences
from clsplat.bench.environment import describe
from clsplat.bench.field_cells import run_field, source_of
from clsplat.bench.measures import (
    Masks,
    digest_of,
    facts_of,
    frames_per_second,
    measure,
    sample_iterations,
    training_psnr,
)
from clsplat.bench.quality_summary import METRICS
from clsplat.bench.results import KEYS, Record, append_record, read_records, write_records
from clsplat.config import BACKGROUNDS, DataConfig, TrainConfig
from clsplat.dataset import load_scene
from clsplat.dataset.brightness import evened
from clsplat.dataset.coverage import rare_pixels
from clsplat.device import Device
from clsplat.errors import ClsplatError, InputError
from clsplat.fields import METHODS
from clsplat.gaussians import Gaussians
from clsplat.ranges import parse_bytes
from clsplat.renderer import Renderer, fetch
from clsplat.scene import Scene
from clsplat.training.loop import train
from clsplat.training.moving import still
from clsplat.training.moving_files import load_masks
from clsplat.training.preparation import prepare

WARM_UP = 4
"""Number of iterations of a separate training before the clock starts. Drivers finish kernels at their first run."""


def run_cells(cells: list[Cell], device: Device, results: Path, say: Callable[[str], None]) -> None:
    """Run the trainings that are not finished yet. Each sample is appended to `results` when it is taken.

    A cell that failed, was interrupted, or has other settings or photos than before runs again, and its old records
    are removed. A failure is recorded with its reason, and the next cell runs.

    Parameters
    ----------
    cells : list of Cell
        Cells of one scene should follow each other: the photos are then read once.
    device : Device
        Device for evaluations. Each training has its own `Device` on the same hardware, to measure its memory.
    results : Path
        File of JSON lines.
    say : callable
        Receives messages, one line each.
    """
    about = describe(device)
    label = about["device"]["label"]
    records = read_records(results)
    reader = Reader()
    missing = [cell for cell in cells if not _finished(cell, records, label, reader)]
    stale = [cell.key(label) for cell in missing]
    write_records(results, [r for r in records if {name: r[name] for name in KEYS} not in stale])
    say(f"{len(cells) - len(missing)} of {len(cells)} trainings are already finished")
    environment = {
        "driver": about["device"]["driver"],
        "compute_units": about["device"]["compute_units"],
        "version": about["software"]["clsplat"],
        "commit": about["software"]["commit"],
        "load": about["load"],
    }
    for number, cell in enumerate(missing, start=1):
        say(f"[{number}/{len(missing)}] {cell.label}")

        def record(values: Record, cell: Cell = cell) -> None:
            now = datetime.now(timezone.utc).isoformat(timespec="seconds")
            key = cell.key(label) | {"settings": differences(cell.config)}
            append_record(results, key | values | environment | {"date": now})

        try:
            scene, rare = reader.read(source_of(cell))
            if cell.method in METHODS:
                last = run_field(METHODS[cell.method], cell.config, scene, device, record, rare)
            else:
                start, config = prepare(cell.source.path, cell.config, device, scene=scene)
                last = run_cell(config, start, device, record, rare)
            flips = "" if last["flip"] is None else f", FLIP {last['flip']:.3f}"
            count = last["num_gaussians"]
            size = f"{last['spz_bytes'] / 1e6:.3g} MB" if count is None else f"{count:,} Gaussians"
            psnr = METRICS["psnr"].written(last["psnr"]) or "no error"
            say(
                f"    {psnr}, SSIM {last['ssim']:.3f}{flips}; {last['seconds']:.0f} s, {size}, "
                f"{last['fps']:.1f} frames/s"
            )
        except Exception as error:  # any error is the result of this cell
            reason = _reason(error, cell.source.path)
            record({"failed": reason})
            say(f"    failed: {reason}")


Variant = tuple[Scene, Masks | None]


class Reader:
    """Reader of datasets and of variants of them. The last dataset and the last variant are kept."""

    def __init__(self) -> None:
        self._dataset: tuple[Path, DataConfig, Scene] | None = None
        self._source: Source | None = None
        self._variant: Variant | ClsplatError | None = None

    def read(self, source: Source) -> Variant:
        """Make the variant of a dataset, and find its rare pixels.

        An error is raised again, without another attempt, for as long as the same source is read.
        """
        if source != self._source:
            self._source, self._variant = source, None
            try:
                self._variant = self._make(source)
            except ClsplatError as error:
                self._variant = error
        if not isinstance(self._variant, tuple):
            raise self._variant or ClsplatError(f"cannot read {source.path}, see above")
        return self._variant

    def _make(self, source: Source) -> Variant:
        if self._dataset is None or self._dataset[:2] != (source.path, source.data):
            self._dataset = None  # frees the memory of the previous photos
            self._dataset = source.path, source.data, load_scene(source.path, source.data)
        whole = self._dataset[2]
        scene = captured(whole, source.capture)
        if not scene.test:
            raise InputError(f"{source.path}: expected held-out photos to measure on, found none")
        # All points of the dataset: which pixels are rare does not depend on the points from which training starts.
        return scene, rare_pixels(scene, whole.points)


def _reason(error: Exception, path: Path) -> str:
    """Reason of a failure, without the folders that contain the dataset, so that it is valid on other machines."""
    text = str(error) if isinstance(error, ClsplatError) else f"{type(error).__name__}: {error}"
    text = text.replace(str(path.resolve()), path.resolve().name)
    return text.replace(str(path), path.name) if path.name else text  # "." has no name


def _finished(cell: Cell, records: list[Record], device: str, reader: Reader) -> bool:
    wanted = cell.key(device) | {"settings": differences(cell.config)}
    photos = [r.get("photos") for r in records if "fps" in r and {k: r.get(k) for k in wanted} == wanted]
    if not photos:
        return False
    try:
        return digest_of(reader.read(source_of(cell))[0]) in photos
    except ClsplatError:  # results are kept without their dataset
        return True


def run_cell(
    config: TrainConfig,
    scene: Scene,
    evaluator: Device,
    record: Callable[[Record], None],
    rare: Masks | None = None,
) -> Record:
    """Run one training, and return its last sample, which also has the PSNR of training photos and the frame rate.

    Parameters
    ----------
    config : TrainConfig
    scene : Scene
        Must have held-out photos. Both as `prepare` returns them.
    evaluator : Device
        Renders the held-out views. It is not the `Device` that trains, whose memory is measured.
    record : callable
        Receives each sample.
    rare : list of (H, W) bool, optional
        Pixels of each held-out photo whose PSNR is measured apart.
    """
    limit = None if config.memory_limit is None else parse_bytes(config.memory_limit, "--memory-limit")
    facts = facts_of(scene, rare)
    at = sample_iterations(config.iterations)
    renderer = Renderer(evaluator, config.render, BACKGROUNDS[config.data.background])
    device = Device(evaluator.cl_device, memory_limit=limit)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # A file format that cannot store everything would warn once per cell.
        warnings.simplefilter("ignore")
        out = Path(folder)
        train(scene, replace(config, iterations=WARM_UP, strategy="adc", size="fixed"), out, device)
        clocks = time.perf_counter, time.process_time
        evaluating = np.zeros(2)
        best: float | None = None
        pending = iter(at)
        started = np.array([clock() for clock in clocks])

        def sample(iteration: int, gaussians: Gaussians) -> Record:
            nonlocal evaluating, best
            now = np.array([clock() for clock in clocks])
            seconds, cpu_seconds = map(float, now - started - evaluating)
            values = facts | {"iteration": iteration, "seconds": seconds, "cpu_seconds": cpu_seconds}
            values |= measure(fetch(gaussians), scene.test, renderer, out, rare)
            if values["psnr"] is not None:
                best = values["psnr"] if best is None else max(best, values["psnr"])
            values |= {"best": best, "memory_bytes": device.memory_peak}
            evaluating += np.array([clock() for clock in clocks]) - now
            return values

        def evaluate(gaussians: Gaussians) -> dict[str, float]:
            values = sample(next(pending), gaussians)
            record(values)
            bar.set_postfix_str(f"{values['psnr']:.2f} dB" if values["psnr"] is not None else "")
            return {}

        with tqdm(total=config.iterations, unit="it", dynamic_ncols=True, leave=False) as bar:

            def progress(now: dict[str, Any]) -> None:
                bar.update(now["iteration"] - bar.n)

            gaussians = train(
                scene, config, out, device, evaluate=evaluate, evaluate_after=set(at[:-1]), progress=progress
            )
        values = sample(config.iterations, gaussians)
        values |= training_psnr(gaussians, still(evened(scene).train, load_masks(out)), renderer)
        values |= {"fps": frames_per_second(gaussians, scene.test, renderer)}
        record(values)
    return values
