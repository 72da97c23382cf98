"""Quality against time, Gaussians, bytes and memory: trainings by several methods, measured while they run."""

import math
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

from clsplat.bench.cells import Cell, Source, differences
from clsplat.bench.environment import describe
from clsplat.bench.results import KEYS, Record, append_record, read_records, write_records
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.errors import ClsplatError, InputError
from clsplat.evaluate import mean_metrics
from clsplat.formats import save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.metrics import flip, psnr, ssim
from clsplat.render import renderings
from clsplat.renderer import Renderer, fetch
from clsplat.scene import Scene, View
from clsplat.training.loop import train
from clsplat.training.preparation import prepare

SAMPLES = 8
"""Number of samples of a training. Their iterations form a geometric sequence."""

FIRST_SAMPLE = 1 / 50
"""Position of the first sample, as a fraction of the iterations. Earlier renders show little."""

WARM_UP = 4
"""Number of iterations of a separate training before the clock starts. Drivers finish kernels at their first run."""

FRAMES = 5
"""Number of times that each held-out view is rendered for the rate of frames."""


def run_cells(cells: list[Cell], device: Device, results: Path, say: Callable[[str], None]) -> None:
    """Run the trainings that are not finished yet. Each sample is appended to `results` when it is taken.

    A cell that failed, was interrupted, or has other settings than before runs again, and its old records are
    removed. A failure is recorded with its reason, and the next cell runs.

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
    missing = [cell for cell in cells if not _finished(cell, records, label)]
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
    source: Source | None = None
    scene: Scene | ClsplatError | None = None
    for number, cell in enumerate(missing, start=1):
        say(f"[{number}/{len(missing)}] {cell.label}")

        def record(values: Record, cell: Cell = cell) -> None:
            now = datetime.now(timezone.utc).isoformat(timespec="seconds")
            key = cell.key(label) | {"settings": differences(cell.config)}
            append_record(results, key | values | environment | {"date": now})

        try:
            if cell.source != source:
                source, scene = cell.source, None  # frees the memory of the previous photos
                scene = _load(source)
            if not isinstance(scene, Scene):
                raise scene or ClsplatError(f"cannot read {cell.source.path}, see above")
            start, config = prepare(source.path, cell.config, device, scene=scene)
            last = run_cell(config, start, device, record)
            flips = "" if last["flip"] is None else f", FLIP {last['flip']:.3f}"
            say(
                f"    {last['psnr']:.2f} dB, SSIM {last['ssim']:.3f}{flips}; {last['seconds']:.0f} s, "
                f"{last['num_gaussians']:,} Gaussians, {last['fps']:.1f} frames/s"
            )
        except Exception as error:  # any error is the result of this cell
            reason = _reason(error, cell.source.path)
            record({"failed": reason})
            say(f"    failed: {reason}")


def _load(source: Source) -> Scene | ClsplatError:
    """The scene, or the error that each of its cells reports, without another attempt."""
    try:
        scene = load_scene(source.path, source.data)
    except ClsplatError as error:
        return error
    return scene if scene.test else InputError(f"{source.path}: expected held-out photos to measure on, found none")


def _reason(error: Exception, path: Path) -> str:
    """Reason of a failure, without the folders that contain the dataset, so that it is valid on other machines."""
    text = str(error) if isinstance(error, ClsplatError) else f"{type(error).__name__}: {error}"
    return text.replace(str(path.resolve()), path.name).replace(str(path), path.name)


def _finished(cell: Cell, records: list[Record], device: str) -> bool:
    wanted = cell.key(device) | {"settings": differences(cell.config)}
    return any("fps" in r and {k: r.get(k) for k in wanted} == wanted for r in records)


def run_cell(config: TrainConfig, scene: Scene, evaluator: Device, record: Callable[[Record], None]) -> Record:
    """Run one training, and return its last sample, which also has the rate of frames.

    Parameters
    ----------
    config : TrainConfig
    scene : Scene
        Must have held-out photos. Both as `prepare` returns them.
    evaluator : Device
        Renders the held-out views. It is not the `Device` that trains, whose memory is measured.
    record : callable
        Receives each sample.
    """
    from clsplat.training.memory import parse_bytes

    limit = None if config.memory_limit is None else parse_bytes(config.memory_limit, "--memory-limit")
    facts = _facts(scene)
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
        pending = iter(at)
        started = np.array([clock() for clock in clocks])

        def sample(iteration: int, gaussians: Gaussians) -> Record:
            nonlocal evaluating
            now = np.array([clock() for clock in clocks])
            seconds, cpu_seconds = map(float, now - started - evaluating)
            values = facts | {"iteration": iteration, "seconds": seconds, "cpu_seconds": cpu_seconds}
            values |= measure(fetch(gaussians), scene.test, renderer, out)
            values |= {"memory_bytes": device.memory_peak}
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
        values |= {"fps": frames_per_second(gaussians, scene.test, renderer)}
        record(values)
    return values


def _facts(scene: Scene) -> Record:
    """Numbers of photos, and their largest size."""
    views = scene.train + scene.test
    return {
        "train": len(scene.train),
        "test": len(scene.test),
        "width": max(view.camera.width for view in views),
        "height": max(view.camera.height for view in views),
    }


def sample_iterations(iterations: int) -> list[int]:
    """Iterations after which samples are taken: a geometric sequence that includes the last iteration."""
    return sorted({int(i) for i in np.rint(np.geomspace(max(1, FIRST_SAMPLE * iterations), iterations, SAMPLES))})


def measure(gaussians: Gaussians, views: list[View], renderer: Renderer, folder: Path) -> Record:
    """Quality on held-out views, number of Gaussians, and sizes of files, which are written to `folder`."""
    figures = mean_metrics(gaussians, views, renderer, metrics=(psnr, ssim, flip))
    sizes = {}
    for suffix in ("ply", "spz"):
        path = folder / f"sample.{suffix}"
        save_gaussians(path, gaussians, renderer.config.mode)
        sizes[f"{suffix}_bytes"] = path.stat().st_size
    finite = {name: value if value is not None and math.isfinite(value) else None for name, value in figures.items()}
    return {"num_gaussians": len(gaussians), "sh_degree": gaussians.sh_degree, **sizes, **finite}


def frames_per_second(gaussians: Gaussians, views: list[View], renderer: Renderer) -> float:
    """Reciprocal of the median time from a camera to its image in the host's memory, 1/s."""
    cameras = [view.camera for view in views]
    # One round more than is timed: the first one includes work that the device does only once.
    images = renderings(renderer, gaussians, cameras * (FRAMES + 1))
    seconds = []
    while True:
        started = time.perf_counter()
        if next(images, None) is None:
            break
        seconds.append(time.perf_counter() - started)
    return 1 / float(np.median(seconds[len(cameras) :]))
