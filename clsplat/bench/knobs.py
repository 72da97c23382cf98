"""Time and accuracy of the renderer's settings, called knobs, of which one is changed at a time."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from clsplat.bench.environment import describe
from clsplat.bench.timing import STILL, Clock, clock, quartiles, run_step, training_of
from clsplat.bench.workloads import Workload
from clsplat.config import RenderConfig, TrainConfig
from clsplat.constants import ALPHA_MIN, TRANSMITTANCE_MIN
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.pruning.prices import with_degree
from clsplat.renderer import Renderer, download

ALPHA_MINS = (0.5 * ALPHA_MIN, 2 * ALPHA_MIN, 4 * ALPHA_MIN, 8 * ALPHA_MIN)
TRANSMITTANCE_MINS = (0.1 * TRANSMITTANCE_MIN, 10 * TRANSMITTANCE_MIN, 100 * TRANSMITTANCE_MIN)
"""Values other than the default: one more accurate, the others less and less accurate."""

RENDER_KNOBS = ("tile_size", "sort", "compositor", "mode", "projection")
"""Fields of RenderConfig that are knobs. Each of their values is a setting."""

WARM_UP = 1
"""Number of untimed runs of each kind at the start. They build kernels and fill the pool of buffers."""

Image = NDArray[np.float64]


@dataclass(frozen=True)
class Setting:
    """One value of one knob. All other settings are those of the base."""

    knob: str
    value: str
    render: RenderConfig
    model: dict[str, float] = field(default_factory=dict)
    sh_degree: int | None = None
    real: Literal["float32", "float64"] = "float32"
    optimizer: Literal["device", "numpy"] = "device"

    @property
    def renders(self) -> bool:
        """Whether the knob affects rendering."""
        return self.optimizer == "device"

    @property
    def trains(self) -> bool:
        """Whether training supports the setting: it has no float64."""
        return self.real == "float32"


def settings(base: RenderConfig, sh_degree: int, device: Device) -> Iterator[Setting]:
    """Yield the base, then every other value of every knob that the device supports.

    Parameters
    ----------
    base : RenderConfig
    sh_degree : int
        Degree of the Gaussians' spherical harmonics.
    device : Device
    """
    yield Setting("default", "", base)
    hints = get_type_hints(RenderConfig)
    for knob in RENDER_KNOBS:
        for value in get_args(hints[knob]):
            render = replace(base, **{knob: value})
            refused = render.projection == "ray" and render.sort == "pixel"
            if value not in (getattr(base, knob), "auto") and not refused:
                yield Setting(knob, str(value), render)
    for name, values, default in (
        ("ALPHA_MIN", ALPHA_MINS, ALPHA_MIN),
        ("TRANSMITTANCE_MIN", TRANSMITTANCE_MINS, TRANSMITTANCE_MIN),
    ):
        for value in values:
            yield Setting(name, f"{value / default:g} x", base, model={name: value})
    for degree in range(sh_degree):
        yield Setting("SH degree", str(degree), base, sh_degree=degree)
    if "cl_khr_fp64" in device.cl_device.extensions:
        yield Setting("real", "float64", base, real="float64")
    yield Setting("optimizer", "numpy", base, optimizer="numpy")


class _Run:
    """The two jobs of a setting on a workload that are timed: rendering its view, and a training step."""

    def __init__(self, setting: Setting, workload: Workload, device: Device) -> None:
        gaussians = workload.gaussians
        if setting.sh_degree is not None:
            gaussians = with_degree(gaussians, setting.sh_degree)
        self.device = Device(device.cl_device, setting.real, device.memory_limit, setting.model)
        self.renderer, self.camera = Renderer(self.device, setting.render), workload.view.camera
        self.gaussians = self.renderer.place(gaussians)
        if setting.trains:
            config = TrainConfig(
                strategy="adc", size="fixed", render=setting.render, optim=STILL, optimizer=setting.optimizer
            )
            training = training_of(replace(workload, gaussians=gaussians), config, self.device)
            self.step = partial(run_step, training)

    def render(self) -> Any:
        """Render the image on the device, and wait until it is finished."""
        run = self.renderer.forward(self.gaussians, self.camera, gradients=False)
        self.device.queue.finish()
        return run.image.rgb


def twin_image(gaussians: Gaussians, workload: Workload, base: RenderConfig) -> Image:
    """Image for all comparisons: the float64 twin with default constants and all spherical harmonics."""
    image: Image = Renderer("reference", base).forward(gaussians, workload.view.camera, gradients=False).image.rgb
    return image


def error(image: NDArray[Any], truth: Image) -> dict[str, float]:
    """Largest and root-mean-square difference, and PSNR, dB, of an image from the twin's. Neither is clamped."""
    difference = np.abs(image - truth)
    rms = float(np.sqrt(np.mean(difference**2)))
    return {"max_abs": float(difference.max()), "rms": rms, "psnr": float(-20 * np.log10(max(rms, 1e-300)))}


def bench_workload(
    workload: Workload, base: RenderConfig, device: Device, repeats: int, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Measure time and error of every setting on a workload.

    Runs of a setting and of the default alternate, so that other work on the machine affects both. `ratio` is the
    median of the quotients of neighbouring runs.

    Returns
    -------
    dict
        name, gaussians, width, height, sh_degree, mode; results: per setting knob, value, render and step (each a
        summary as of `clsplat bench kernels`, and ratio; null if the knob does not apply to the job), error (max_abs,
        rms, psnr).
    """
    gaussians, camera = workload.gaussians, workload.view.camera
    progress(f"{workload.name}: float64 twin")
    truth = twin_image(gaussians, workload, base)
    cores = device.cl_device.max_compute_units if device.is_cpu else None
    default, *others = settings(base, gaussians.sh_degree, device)
    reference = _Run(default, workload, device)
    results = []
    for setting in (default, *others):
        progress(f"{workload.name}: {setting.knob} {setting.value}".rstrip())
        run = reference if setting is default else _Run(setting, workload, device)
        render = _paired(reference.render, run.render, repeats, cores) if setting.renders else None
        step = _paired(reference.step, run.step, repeats, cores) if setting.trains else None
        found = {"render": render, "step": step, "error": error(download(run.render()), truth)}
        results.append({"knob": setting.knob, "value": setting.value, **found})
    return {
        "name": workload.name,
        "gaussians": len(gaussians),
        "width": camera.width,
        "height": camera.height,
        "sh_degree": gaussians.sh_degree,
        "mode": base.mode,
        "results": results,
    }


def _paired(
    reference: Callable[[], Any], job: Callable[[], Any], repeats: int, cores: int | None
) -> dict[str, float]:
    """Quartiles of a job's times, and the median of its time divided by that of the preceding reference run."""
    samples: list[Clock] = []
    quotients = []
    for repeat in range(-WARM_UP, repeats):
        start = clock()
        reference()
        middle = clock()
        job()
        end = clock()
        if repeat >= 0:
            samples.append(end - middle)
            # If the device is a CPU, compare CPU times: other work on the machine does not add to them.
            which = 0 if cores is None else 1
            quotients.append((end - middle)[which] / (middle - start)[which])
    return {**quartiles(samples, cores), "ratio": round(float(np.median(quotients)), 4)}


def bench_knobs(
    workloads: list[Workload],
    render: RenderConfig,
    device: Device,
    repeats: int,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Measure every setting of every knob on every workload.

    Parameters
    ----------
    workloads : list of Workload
    render : RenderConfig
        The default that single knobs are changed from. The mode of a workload from a file takes precedence.
    device : Device
    repeats : int
        Number of timed runs of each kind, at least 1.
    progress : callable
        Receives the name of each measurement before it starts.

    Returns
    -------
    dict
        Content of the file of `clsplat bench knobs -o FILE`: device, software, date, settings, workloads.
    """
    results: dict[str, Any] = {
        "benchmark": "knobs",
        **describe(device),
        "settings": {"repeats": repeats, **asdict(render)},
    }
    results["workloads"] = [
        bench_workload(w, replace(render, mode=w.mode or render.mode), device, repeats, progress) for w in workloads
    ]
    return results
