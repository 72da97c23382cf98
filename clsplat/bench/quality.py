"""What time, Gaussians, bytes and memory buy in quality: trainings by several methods, sampled while they run."""

import json
import math
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from clsplat.bench.environment import describe
from clsplat.bench.results import KEYS, Record, append_record, read_records, write_records
from clsplat.config import BACKGROUNDS, DataConfig, TrainConfig
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
from clsplat.training.presets import YAML, load_config, load_preset, with_settings

SAMPLES = 8
"""Samples of a training, at equal factors of iterations."""

FIRST_SAMPLE = 1 / 50
"""Of the iterations, where the first sample is taken: before it there is little to see."""

WARM_UP = 4
"""Iterations before the clock starts, on a copy: drivers finish their kernels when these first run."""

FRAMES = 5
"""Times that each held-out view is rendered for the rate of frames."""

OWN = "own"
"""The budget that a method's own settings name."""


@dataclass(frozen=True)
class Source:
    """A dataset and how it is read; `name` is what results call it."""

    name: str
    path: Path
    data: DataConfig


@dataclass(frozen=True)
class Cell:
    """One training: a method with a cap on a scene."""

    source: Source
    method: str
    config: TrainConfig

    def key(self, device: str) -> Record:
        """What tells its records from those of others."""
        return {
            "scene": self.source.name,
            "method": self.method,
            "max_gaussians": self.config.max_gaussians,
            "iterations": self.config.iterations,
            "device": device,
        }

    @property
    def label(self) -> str:
        """For people."""
        cap = self.config.max_gaussians
        limit = "" if cap is None else f", at most {cap:,} Gaussians"
        return f"{self.source.name}, {self.method}{limit}, {self.config.iterations:,} iterations"


def parse_source(text: str) -> Source:
    """A dataset as the command line names it: FOLDER, or FOLDER:downscale=2:background=white.

    Raises
    ------
    InputError
        If an option is no setting of `DataConfig`, or its value none that it takes.
    """
    # Colons before the first option belong to the path, as after a drive's letter.
    match = re.fullmatch(r"(.+?)((?::\w+=[^:]*)*)", text, flags=re.DOTALL)
    if match is None:
        raise InputError(f"data: expected a folder, found {text!r}")
    options = dict(option.split("=", 1) for option in match[2].split(":")[1:])
    data = with_settings(DataConfig(), {name: _value(value) for name, value in options.items()}, text)
    path = Path(match[1])
    return Source(path.resolve().name + match[2], path, data)


def _value(text: str) -> Any:
    """JSON, or a text that needs no quotes."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def parse_method(text: str) -> tuple[str, TrainConfig]:
    """A method's name and settings: a preset, or a file as ``train --config`` takes it."""
    return (
        (Path(text).stem, load_config(Path(text))) if text.endswith((".json", *YAML)) else (text, load_preset(text))
    )


def parse_budget(text: str, own: int | None) -> int | None:
    """The cap that a budget means for a method whose settings have the cap `own`.

    Raises
    ------
    InputError
        If it is neither "own", nor a factor such as x0.5, nor a number of Gaussians.
    """
    if text == OWN:
        return own
    if re.fullmatch(r"x\d*\.?\d+", text) and float(text[1:]) > 0:
        return None if own is None else max(1, round(float(text[1:]) * own))
    if re.fullmatch(r"[1-9]\d*", text):
        return int(text)
    raise InputError(
        f"--budgets: expected {OWN}, a factor such as x0.5, or a number of Gaussians such as 40000, found {text!r}"
    )


def make_cells(
    sources: Iterable[str],
    methods: Iterable[str],
    budgets: Iterable[str],
    iterations: Iterable[int],
    memory_limit: str | None = None,
) -> list[Cell]:
    """Each method with each budget for each number of iterations on each scene, once.

    Parameters
    ----------
    sources : iterable of str
        As `parse_source` takes them.
    methods : iterable of str
        As `parse_method` takes them.
    budgets : iterable of str
        As `parse_budget` takes them.
    iterations : iterable of int
        None at all: each method's own number.
    memory_limit : str, optional
        As in `TrainConfig`.

    Raises
    ------
    InputError
        If one of them is none of its kind, or two datasets or methods have one name.
    """
    iterations, cells = list(iterations), []
    for number in iterations:
        if number < 1:
            raise InputError(f"--iterations: expected 1 or more, found {number}")
    named_sources = _unlike([parse_source(text) for text in dict.fromkeys(sources)], lambda s: s.name, "data")
    named_methods = _unlike([parse_method(text) for text in dict.fromkeys(methods)], lambda m: m[0], "--methods")
    for source in named_sources:
        for method, base in named_methods:
            for budget in budgets:
                for number in iterations or [base.iterations]:
                    config = replace(
                        base,
                        iterations=number,
                        max_gaussians=parse_budget(budget, base.max_gaussians),
                        data=source.data,
                        # Never before the end, which is not timed.
                        checkpoint_every=number,
                        device=None,
                        memory_limit=memory_limit,
                    )
                    cells.append(Cell(source, method, config))
    return list(dict.fromkeys(cells))


def _unlike(items: list[Any], name: Callable[[Any], str], what: str) -> list[Any]:
    names = [name(item) for item in items]
    for text in names:
        if names.count(text) > 1:
            raise InputError(f"{what}: expected names that differ, found {text} {names.count(text)} times")
    return items


def differences(config: TrainConfig) -> Record:
    """The settings that are not the defaults, nested as in config.json."""

    def differing(mine: Record, default: Record) -> Record:
        found = {}
        for name, value in mine.items():
            if isinstance(value, dict):
                value = differing(value, default[name])
            if value != ({} if isinstance(value, dict) else default[name]):
                found[name] = value
        return found

    return differing(asdict(config), asdict(TrainConfig()))


def run_cells(cells: list[Cell], device: Device, results: Path, say: Callable[[str], None]) -> None:
    """Train what is not there yet; every sample is appended to `results` when it is taken.

    A cell that failed, that was interrupted, or whose settings were others, runs anew; its old records go. What fails
    is recorded with its reason, and the next cell runs.

    Parameters
    ----------
    cells : list of Cell
        Those of one scene one after the other: its photos are read once.
    device : Device
        Names the device, and evaluates. Each training has its own, whose memory is its own.
    results : Path
        File of JSON lines.
    say : callable
        Told what happens, a line at a time.
    """
    about = describe(device)
    label = about["device"]["label"]
    records = read_records(results)
    missing = [cell for cell in cells if not _finished(cell, records, label)]
    anew = [cell.key(label) for cell in missing]
    write_records(results, [r for r in records if {name: r[name] for name in KEYS} not in anew])
    say(f"{len(cells) - len(missing)} of {len(cells)} trainings are there already")
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
                source, scene = cell.source, None  # room for its photos
                scene = _load(source)
            if not isinstance(scene, Scene):
                raise scene or ClsplatError(f"{cell.source.path}: could not be read, see above")
            start, config = prepare(source.path, cell.config, device, scene=scene)
            last = run_cell(config, start, device, record)
            flips = "" if last["flip"] is None else f", FLIP {last['flip']:.3f}"
            say(
                f"    {last['psnr']:.2f} dB, SSIM {last['ssim']:.3f}{flips}; {last['seconds']:.0f} s, "
                f"{last['num_gaussians']:,} Gaussians, {last['fps']:.1f} frames/s"
            )
        except Exception as error:  # whatever it is, it is this cell's result
            reason = _reason(error, cell.source.path)
            record({"failed": reason})
            say(f"    failed: {reason}")


def _load(source: Source) -> Scene | ClsplatError:
    """The scene, or why there is none: what each of its cells then says, without another try."""
    try:
        scene = load_scene(source.path, source.data)
    except ClsplatError as error:
        return error
    return scene if scene.test else InputError(f"{source.path}: expected held-out photos to measure on, found none")


def _reason(error: Exception, path: Path) -> str:
    """Why a cell failed, in words that hold on another machine, too: without the folders that the dataset is in."""
    text = str(error) if isinstance(error, ClsplatError) else f"{type(error).__name__}: {error}"
    return text.replace(str(path.resolve()), path.name).replace(str(path), path.name)


def _finished(cell: Cell, records: list[Record], device: str) -> bool:
    wanted = cell.key(device) | {"settings": differences(cell.config)}
    return any("fps" in r and {k: r.get(k) for k in wanted} == wanted for r in records)


def run_cell(config: TrainConfig, scene: Scene, evaluator: Device, record: Callable[[Record], None]) -> Record:
    """Train once; hand each sample to `record`, and return the last, which has the rate of frames.

    Parameters
    ----------
    config : TrainConfig
    scene : Scene
        With held-out photos; both as `prepare` returns them.
    evaluator : Device
        Renders the held-out views: apart from the device that trains, whose memory is measured.
    record : callable
    """
    from clsplat.training.memory import parse_bytes

    limit = None if config.memory_limit is None else parse_bytes(config.memory_limit, "--memory-limit")
    views = scene.train + scene.test
    facts = {
        "train": len(scene.train),
        "test": len(scene.test),
        "width": max(view.camera.width for view in views),
        "height": max(view.camera.height for view in views),
    }
    at = sample_iterations(config.iterations)
    renderer = Renderer(evaluator, config.render, BACKGROUNDS[config.data.background])
    device = Device(evaluator.cl_device, memory_limit=limit)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # Of what a file format cannot hold: once per cell would be too often.
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


def sample_iterations(iterations: int) -> list[int]:
    """Iterations after which samples are taken, the last one included: at equal factors."""
    return sorted({int(i) for i in np.rint(np.geomspace(max(1, FIRST_SAMPLE * iterations), iterations, SAMPLES))})


def measure(gaussians: Gaussians, views: list[View], renderer: Renderer, folder: Path) -> Record:
    """Quality on held-out views, and size: in Gaussians, and in bytes of the files that `folder` is for."""
    figures = mean_metrics(gaussians, views, renderer, metrics=(psnr, ssim, flip))
    sizes = {}
    for suffix in ("ply", "spz"):
        path = folder / f"sample.{suffix}"
        save_gaussians(path, gaussians, renderer.config.mode)
        sizes[f"{suffix}_bytes"] = path.stat().st_size
    finite = {name: value if value is not None and math.isfinite(value) else None for name, value in figures.items()}
    return {"num_gaussians": len(gaussians), "sh_degree": gaussians.sh_degree, **sizes, **finite}


def frames_per_second(gaussians: Gaussians, views: list[View], renderer: Renderer) -> float:
    """Images per second: one over the median time from a camera to its image in the host's memory."""
    cameras = [view.camera for view in views]
    # Once more than is timed: what is first for the device is done in the first round.
    images = renderings(renderer, gaussians, cameras * (FRAMES + 1))
    seconds = []
    while True:
        started = time.perf_counter()
        if next(images, None) is None:
            break
        seconds.append(time.perf_counter() - started)
    return 1 / float(np.median(seconds[len(cameras) :]))
