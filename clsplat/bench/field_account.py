"""Account of the time of radiance fields: evaluations per pixel, operations, bytes, and the share of each stage."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from clsplat.bench.environment import describe
from clsplat.bench.kernel_report import Results, milliseconds, origin, table
from clsplat.bench.roof import measure_roof
from clsplat.bench.timing import Clock, clock
from clsplat.config import BACKGROUNDS, DataConfig
from clsplat.device import Device
from clsplat.fields import Field
from clsplat.fields.pixels import Pixels
from clsplat.fields.space import Space
from clsplat.randomness import stream
from clsplat.scene import Scene
from clsplat.stages import FUNCTIONS

CORNERS = 8
"""Entries of a grid that are read for a point."""

HEADS = ("heads_fwd", "heads_sh_fwd", "heads_soft_fwd")
"""Stages that make densities: each of their rows is an evaluation of a field."""


class Work:
    """Work of the stages: evaluations of the field, operations of networks, bytes, and clocks by stage.

    Bytes are those of the arrays that a stage reads and writes, each once; of tables, the entries of the points.
    """

    def __init__(self) -> None:
        self.evaluations = self.operations = self.bytes = 0
        self.time: defaultdict[str, Clock] = defaultdict(lambda: np.zeros(2))

    def count(self, name: str, args: tuple[Any, ...], result: Any) -> None:
        """Add a call of a stage."""
        self.bytes += sum(array.nbytes for array in {id(a): a for a in _arrays((args, result))}.values())
        if name in HEADS:
            self.evaluations += args[0].shape[0]
        if name == "mlp_fwd":
            self.operations += 2 * args[0].shape[0] * args[1].size
        if name == "mlp_bwd":
            inputs, weights, widths, _, _, columns, *_ = args
            needed = 2 * weights.size - (widths[0] - columns) * widths[1]
            self.operations += 2 * inputs.shape[0] * needed
        if name == "hashgrid_fwd":
            self.bytes += CORNERS * result.nbytes - args[1].nbytes
        if name == "voxels_fwd":
            self.bytes += CORNERS * (result.nbytes + 4 * args[0].shape[0]) - args[1].nbytes - args[2].nbytes


def _arrays(value: Any) -> Iterator[Any]:
    if hasattr(value, "nbytes"):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from _arrays(part)


@contextmanager
def watched(field: Field) -> Iterator[Work]:
    """Count and time the stages of a field, by waiting after each."""
    work, functions = Work(), {name: getattr(field.stages, name) for name in FUNCTIONS}

    def timed(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        start = clock()
        result = function(*args, **kwargs)
        field.device.queue.finish()
        work.time[name] += clock() - start
        work.count(name, args, result)
        return result

    for name, function in functions.items():
        setattr(field.stages, name, partial(timed, name, function))
    try:
        yield work
    finally:
        for name, function in functions.items():
            setattr(field.stages, name, function)


def account(
    method: type[Field], scene: Scene, config: DataConfig, device: Device, iterations: int, steps: int
) -> Results:
    """Train a field, then count and time some steps, and an image.

    Parameters
    ----------
    method : type of Field
    scene : Scene
        Loaded with random backgrounds, which keeps the transparency of photos.
    config : DataConfig
        With which it was loaded.
    device : Device
    iterations : int
        Steps before those that are counted: grids of occupied cells find the empty ones meanwhile.
    steps : int
        Number of steps that are counted.

    Returns
    -------
    dict
        method, rays of a step, and for "step" and "image": wall and processor time in s, evaluations, operations and
        bytes, all of them per ray, and the time of each stage.
    """
    background = BACKGROUNDS[config.background]
    field = method(Space.of(scene.train), device, 0)
    pixels = Pixels(scene.train, field.space, background)

    def run(count: int) -> int:
        rays = 0
        for _ in range(count):
            batch = pixels.draw(stream(0, "pixels of a batch", field.iteration + 1), field.rays)
            field.step(batch, field.iteration / (iterations + steps))
            rays += len(batch.colors)
        return rays

    run(iterations)
    with watched(field) as work:
        start = clock()
        rays = run(steps)
        step = _per_ray(work, clock() - start, rays)
    camera = (scene.test or scene.train)[0].camera
    with watched(field) as work:
        start = clock()
        field.image(camera, background)
        image = _per_ray(work, clock() - start, camera.width * camera.height)
    return {"method": method.name, "rays": rays / steps, "step": step, "image": image}


def _per_ray(work: Work, spent: Clock, rays: int) -> Results:
    found = {"evaluations": work.evaluations, "operations": work.operations, "bytes": work.bytes}
    wall, cpu = map(float, spent)
    result: Results = {name: value / rays for name, value in found.items()}
    stages = {name: [float(t) / rays for t in time] for name, time in work.time.items()}
    return result | {"seconds": wall / rays, "cpu_seconds": cpu / rays, "stages": stages}


def bench_fields(
    methods: list[type[Field]],
    scene: Scene,
    config: DataConfig,
    device: Device,
    iterations: int,
    steps: int,
    progress: Callable[[str], None],
) -> Results:
    """Account of several methods on one scene: the file of `clsplat bench fields -o FILE`."""
    progress("roof")
    results: Results = describe(device) | {"benchmark": "fields", "roof": measure_roof(device)}
    results["settings"] = {"iterations": iterations, "repeats": steps}
    results["methods"] = []
    for method in methods:
        progress(method.name)
        results["methods"].append(account(method, scene, config, device, iterations, steps))
    return results


def _share(rate: float, roof: float) -> str:
    percent = 100 * rate / roof
    return f"{percent:.2g} %" if percent < 99.5 else f"{percent:.0f} %"


def fields_text(results: Results) -> str:
    """Two tables: what a pixel costs in an image and a ray in a step, and the stages of a step by method."""
    roof = results["roof"]
    head = (
        "method",
        "for each",
        "evaluations",
        "MFLOP",
        "kB",
        "time, us",
        "processor, us",
        "of multiply-add",
        "of copy",
    )
    rows, shares = [head], [("method", "share of the time of a step, by stage")]
    for found in results["methods"]:
        for name, what in (("image", "pixel of an image"), ("step", "ray of a step")):
            own = found[name]
            rates = 1e-9 * own["operations"] / own["seconds"], 1e-9 * own["bytes"] / own["seconds"]
            texts = [_share(*pair) for pair in zip(rates, (roof["fma_gflops"], roof["copy_gbs"]), strict=True)]
            numbers = f"{own['evaluations']:.4g}", f"{1e-6 * own['operations']:.3g}", f"{1e-3 * own['bytes']:.3g}"
            times = (milliseconds(1e6 * own[key]) for key in ("seconds", "cpu_seconds"))
            rows.append((found["method"], what, *numbers, *times, *texts))
        step = found["step"]
        # Wall times would show what other processes do; a stage's processor time includes all of its threads.
        clock_used = int(results["device"]["kind"] == "cpu")
        spent = {name: time[clock_used] for name, time in step["stages"].items()}
        whole = step["cpu_seconds" if clock_used else "seconds"]
        largest = sorted(spent, key=lambda name: -spent[name])
        texts = [f"{name} {_share(spent[name], whole)}" for name in largest if spent[name] > 0.02 * whole]
        shares.append((found["method"], ", ".join(texts)))
    settings = results["settings"]
    trained = f"after {settings['iterations']:,} iterations" + (
        f" on {settings['scene']}" if "scene" in settings else ""
    )
    facts = "\n".join(f"- {fact}" for fact in [*origin(results), trained])
    return f"{facts}\n\n{table(rows)}\n\n{table(shares)}"
