"""Timings of a training step, its stages and their kernels, and the fractions of the device's limits they reach."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np

from clsplat.bench.environment import describe
from clsplat.bench.networks import bench_networks
from clsplat.bench.roof import measure_roof
from clsplat.bench.timing import STILL, Clock, clock, quartiles, run_step, training_of
from clsplat.bench.workloads import Workload
from clsplat.config import SHORT_RUN, RenderConfig, TrainConfig
from clsplat.device import Device
from clsplat.renderer import Renderer
from clsplat.stages import FUNCTIONS
from clsplat.training.session import Training

WARM_UP = 2
"""Number of untimed steps of each kind at the start. They build kernels and fill the pool of buffers."""

REAL = 4
"""Size of a real number, bytes."""


class _Spent:
    """Time and number of calls of stages or kernels by name, in the order of first calls."""

    def __init__(self) -> None:
        self.time: defaultdict[str, Clock] = defaultdict(lambda: np.zeros(2))
        self.calls: defaultdict[str, int] = defaultdict(int)


@contextmanager
def _watched(training: Training, kernels: bool) -> Iterator[_Spent]:
    """Time a training's stages, or the kernels they launch as STAGE/KERNEL, by waiting after each."""
    device, launches = training.device, training.renderer.stages
    spent, functions = _Spent(), {name: getattr(launches, name) for name in FUNCTIONS}
    launch, stage = device.launch, ""

    def timed(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        start = clock()
        result = function(*args, **kwargs)
        device.queue.finish()
        spent.time[name] += clock() - start
        spent.calls[name] += 1
        return result

    def entered(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        nonlocal stage
        stage = name
        return function(*args, **kwargs)

    def timed_launch(folder: str, kernel: str, *args: Any, **kwargs: Any) -> None:
        timed(f"{stage}/{kernel}", launch, folder, kernel, *args, **kwargs)

    for name, function in functions.items():
        setattr(launches, name, partial(entered if kernels else timed, name, function))
    if kernels:
        vars(device)["launch"] = timed_launch  # shadows the method
    try:
        yield spent
    finally:
        vars(device).pop("launch", None)
        for name, function in functions.items():
            setattr(launches, name, function)


def stage_bytes(n: int, sh_degree: int, pixels: int, intersections: int) -> dict[str, int]:
    """Smallest number of bytes that each memory-bound stage moves: it reads each input and writes each result once.

    Parameters
    ----------
    n : int
        Number of Gaussians.
    sh_degree : int
    pixels, intersections : int
        Numbers of pixels and of intersections of splats with tiles.
    """
    parameters, splat, splat_grads = 11 + 3 * (sh_degree + 1) ** 2, 12, 9
    return {
        "project_fwd": REAL * n * (parameters + splat),
        "bin_splats": REAL * (n * 9 + 2 * intersections),  # without colours; gauss_ids and slots
        "l1_ssim": pixels * (3 * REAL + 3 + 3 * REAL),  # image, photo in 8 bits, gradient
        "observe": REAL * n * 8,  # extents and gradient; both statistics, read and written
        # Gradients of the splats; extents, conics, colours; parameters and both moments, read and written.
        "project_bwd_adam": REAL * n * (splat_grads + 8 + 6 * parameters),
    }


def _roof_fraction(name: str, result: dict[str, Any], accepted: int, roof: dict[str, float]) -> None:
    """Add rates and the fraction of the roof to the result of a stage."""
    seconds = result["median_ms"] / 1e3
    if name in ("composite_fwd", "composite_bwd"):
        result["gpairs_per_s"] = 1e-9 * accepted / seconds
        result["roof"] = "exp"
        result["roof_fraction"] = result["gpairs_per_s"] / max(roof["exp_gops"], roof["exp2_gops"])
    elif "bytes" in result:
        result["gb_per_s"] = 1e-9 * result["bytes"] / seconds
        result["roof"] = "bandwidth"
        result["roof_fraction"] = result["gb_per_s"] / max(roof["copy_gbs"], roof["triad_gbs"])


def bench_workload(workload: Workload, render: RenderConfig, device: Device, repeats: int) -> dict[str, Any]:
    """Time a training step on a workload. Whole steps, steps by stages and steps by kernels alternate.

    Returns
    -------
    dict
        name, gaussians, width, height, sh_degree, counts; step: a summary; stages: summaries by function of
        `clsplat.ops`, each with the summaries of its kernels. A summary holds median_ms, q1_ms and q3_ms, and on CPUs
        cpu_ms, the CPU time divided by the number of cores.
    """
    gaussians, view = workload.gaussians, workload.view
    config = TrainConfig(strategy="adc", size="fixed", iterations=SHORT_RUN, render=render, optim=STILL)
    renderer = Renderer(device, render)
    run = renderer.forward(gaussians, view.camera)
    pairs = renderer.stages.count_pairs(run.drawn, run.bins)
    evaluated, accepted = (int(a.get().sum(dtype=np.uint64)) for a in pairs)
    counts = {
        "visible": int((run.splats.extents.get()[:, 0] > 0).sum()),
        "intersections": int(run.bins.gauss_ids.shape[0]),
        "pairs_evaluated": evaluated,
        "pairs_accepted": accepted,
    }
    del run

    training = training_of(workload, config, device)
    steps: list[Clock] = []
    samples: defaultdict[str, list[Clock]] = defaultdict(list)
    calls: dict[str, int] = {}
    for repeat in range(-WARM_UP, repeats):
        start = clock()
        run_step(training)
        whole = clock() - start
        for kernels in (False, True):
            with _watched(training, kernels) as spent:
                run_step(training)
            if repeat >= 0:
                calls |= spent.calls
                for name, time in spent.time.items():
                    samples[name].append(time)
        if repeat >= 0:
            steps.append(whole)

    cores = device.cl_device.max_compute_units if device.is_cpu else None
    stages = _stages(samples, calls, cores)
    pixels = view.camera.width * view.camera.height
    for name, moved in stage_bytes(len(gaussians), gaussians.sh_degree, pixels, counts["intersections"]).items():
        if name in stages:
            stages[name]["bytes"] = moved
    return {
        "name": workload.name,
        "gaussians": len(gaussians),
        "width": view.camera.width,
        "height": view.camera.height,
        "sh_degree": gaussians.sh_degree,
        "mode": render.mode,
        "counts": counts,
        "step": quartiles(steps, cores),
        "stages": stages,
    }


def _stages(
    samples: Mapping[str, list[Clock]], calls: Mapping[str, int], cores: int | None
) -> dict[str, dict[str, Any]]:
    """Summaries of the stages with those of their kernels. The name of a kernel in `samples` is STAGE/KERNEL."""
    stages: dict[str, dict[str, Any]] = {}
    for name, clocks in samples.items():
        stage, _, kernel = name.partition("/")
        if kernel:
            stages[stage]["kernels"][kernel] = {"launches": calls[name], **quartiles(clocks, cores)}
        else:
            stages[stage] = {**quartiles(clocks, cores), "kernels": {}}
    return stages


def bench_kernels(
    workloads: list[Workload],
    render: RenderConfig,
    device: Device,
    repeats: int,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Measure the device's limits, before and after everything else, and time all workloads.

    Parameters
    ----------
    workloads : list of Workload
    render : RenderConfig
        Mode, tile size and compositor. The mode of a workload from a file takes precedence.
    device : Device
    repeats : int
        Number of timed steps of each kind (whole, by stages, by kernels), at least 1.
    progress : callable
        Receives the name of each measurement before it starts.

    Returns
    -------
    dict
        Content of the file of `clsplat bench kernels -o FILE`: device, software, date, settings, roof, networks,
        workloads.
    """
    tile_size = Renderer(device, render).tile_size(workloads[0].view.camera)
    results: dict[str, Any] = {
        "benchmark": "kernels",
        **describe(device),
        "settings": {"repeats": repeats, **asdict(render), "tile_size": tile_size},
    }
    progress("roof")
    roof = measure_roof(device)
    timed = []
    for workload in workloads:
        progress(workload.name)
        timed.append(bench_workload(workload, replace(render, mode=workload.mode or render.mode), device, repeats))
    progress("networks")
    results["networks"] = bench_networks(device, repeats)
    progress("roof")
    results["roof"] = _better(roof, measure_roof(device))
    for result in timed:
        for name, stage in result["stages"].items():
            _roof_fraction(name, stage, result["counts"]["pairs_accepted"], results["roof"])
        compositing = sum(result["stages"][name]["median_ms"] for name in ("composite_fwd", "composite_bwd"))
        result["step_over_compositing"] = result["step"]["median_ms"] / compositing
    return results | {"workloads": timed}


def _better(a: dict[str, float], b: dict[str, float]) -> dict[str, float]:
    """The better values of two measurements of the roof: the higher rates and the shorter times."""
    return {key: min(a[key], b[key]) if key.endswith("_us") else max(a[key], b[key]) for key in a}
