"""The sub-commands of `clsplat bench`: a dataclass each, from which tyro makes flags and help."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from clsplat.bench.workloads import DEFAULT, KNOBS_DEFAULT, Workload, from_files, scaling_names, synthetic
from clsplat.config import DataConfig, RenderConfig
from clsplat.errors import ClsplatError, InputError

CHART_SUFFIXES = (".png", ".svg", ".pdf")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


@dataclass(frozen=True)
class Kernels:
    """Time training's step, its stages and their kernels, beside what the device can do at best."""

    workloads: tuple[str, ...] = DEFAULT
    """Synthetic scenes: number of Gaussians and image size."""
    scene: Path | None = None
    """File of Gaussians to time instead; needs --cameras."""
    cameras: Path | None = None
    """Dataset whose views the scene is timed with, as given to `train`."""
    views: int = 1
    """Views of the dataset, evenly spread, each a workload of its own."""
    downscale: Literal[1, 2, 4, 8] = 1
    """Of the dataset's photos, as given to `train`."""
    scaling: Path | None = None
    """Also time more numbers of Gaussians and of pixels, and draw the chart in this file (.png, .svg, .pdf)."""
    repeats: int = 15
    """Steps of each kind that count: whole, stage by stage, kernel by kernel."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """JSON file for all results."""
    device: str | None = None
    """Part of the platform's or device's name."""
    render: Annotated[RenderConfig, tyro.conf.arg(name="")] = field(default_factory=RenderConfig)

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.kernel_report import details, save_scaling_chart, summary
        from clsplat.bench.kernels import bench_kernels
        from clsplat.device import Device, select_device

        _check(self.repeats, self.out, "--scaling", self.scaling)
        workloads = self._workloads()
        device = Device(select_device(self.device))
        _say(f"device: {device.label}")
        results = bench_kernels(workloads, self.render, device, self.repeats, lambda text: _say(f"timing: {text}"))
        _write(self.out, results)
        if self.scaling is not None:
            save_scaling_chart(results, self.scaling)
            _say(f"chart: {self.scaling}")
        print(summary(results))
        for workload in results["workloads"]:
            print(f"\n{details(workload)}")

    def _workloads(self) -> list[Workload]:
        if self.scene is not None and self.scaling is not None:
            raise InputError("--scaling: expected synthetic workloads, found --scene; leave one of them out")
        names = [*self.workloads, *(scaling_names() if self.scaling is not None else ())]
        return _of_files(self.scene, self.cameras, self.views, self.downscale) or [
            synthetic(name) for name in dict.fromkeys(names)
        ]


@dataclass(frozen=True)
class Knobs:
    """Turn each knob of the renderer, one at a time: what it buys in time, and its error against the float64 twin."""

    workload: str = KNOBS_DEFAULT
    """Synthetic scene: number of Gaussians and image size."""
    scene: Path | None = None
    """File of Gaussians to use instead; needs --cameras."""
    cameras: Path | None = None
    """Dataset whose views the scene is seen from, as given to `train`."""
    views: int = 1
    """Views of the dataset, evenly spread, each a workload of its own."""
    downscale: Literal[1, 2, 4, 8] = 1
    """Of the dataset's photos, as given to `train`."""
    repeats: int = 7
    """Runs of each setting that count, in turn with as many of the default."""
    chart: Path | None = None
    """Error against time, for the first workload (.png, .svg, .pdf)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """JSON file for all results."""
    device: str | None = None
    """Part of the platform's or device's name."""
    render: Annotated[RenderConfig, tyro.conf.arg(name="")] = field(default_factory=RenderConfig)
    """What the knobs are turned from."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.knob_report import knobs_text, save_knobs_chart
        from clsplat.bench.knobs import bench_knobs
        from clsplat.device import Device, select_device

        _check(self.repeats, self.out, "--chart", self.chart)
        files = _of_files(self.scene, self.cameras, self.views, self.downscale)
        device = Device(select_device(self.device))
        _say(f"device: {device.label}")
        workloads = files or [synthetic(self.workload)]
        results = bench_knobs(workloads, self.render, device, self.repeats, lambda text: _say(f"turning: {text}"))
        _write(self.out, results)
        if self.chart is not None:
            save_knobs_chart(results, self.chart)
            _say(f"chart: {self.chart}")
        print(knobs_text(results))


@dataclass(frozen=True)
class Stability:
    """Measure the known failures of the method without their remedies and with them."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Experiments; default: all."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for stability.json and for charts. Rows of the file that are not measured now stay as they are."""
    device: str | None = None
    """Part of the platform's or device's name."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.stability.run import measure_rows
        from clsplat.bench.stability.stability_report import table
        from clsplat.device import Device, select_device

        results, failed = measure_rows(self.names, Device(select_device(self.device)), self.out, _say)
        print(table(results))
        if failed:
            raise ClsplatError(f"experiments failed, see above: {', '.join(failed)}")


@dataclass(frozen=True)
class Quality:
    """Train on scenes by several methods, and chart what time, Gaussians, bytes and memory buy in quality."""

    data: tyro.conf.Positional[tuple[str, ...]]
    """Datasets, as given to `train`; how photos are read follows a colon: lego:background=white, fern:downscale=2."""
    methods: tuple[str, ...] = ("paper-7k", "fast")
    """Presets of `train`, or files as its --config takes them."""
    budgets: tuple[str, ...] = ("own",)
    """Caps on the number of Gaussians: a method's own, a factor of it such as x0.5, or a number such as 40000."""
    iterations: tuple[int, ...] = ()
    """Optimisation steps; default: each method's own."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("clsplat-quality")
    """Folder for results.jsonl and the charts. Trainings that it holds are not repeated; failed ones are."""
    device: str | None = None
    """Part of the platform's or device's name."""
    memory_limit: str | None = None
    """Device memory that a training may use, such as 4GB."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.quality import make_cells, run_cells
        from clsplat.bench.results import FILE
        from clsplat.device import Device, select_device

        cells = make_cells(self.data, self.methods, self.budgets, self.iterations, self.memory_limit)
        device = Device(select_device(self.device))
        _say(f"device: {device.label}")
        try:
            self.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.out}: expected a folder that can be made, found: {error.strerror}") from error
        try:
            run_cells(cells, device, self.out / FILE, _say)
        except KeyboardInterrupt:
            _say(f"{self.out}: the same command continues after the last training that ended")
            raise
        Chart(self.out).run()


@dataclass(frozen=True)
class Chart:
    """Draw the charts of `bench quality` from its results."""

    out: tyro.conf.Positional[Path]
    """Folder with results.jsonl, for index.html, and for the charts as PNG and SVG."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.charts_page import write_charts
        from clsplat.bench.results import FILE, read_records

        if not (self.out / FILE).is_file():
            raise InputError(f"{self.out}: expected a folder with {FILE}, which `bench quality` writes, found none")
        write_charts(read_records(self.out / FILE), self.out)
        _say(f"charts: {self.out / 'index.html'}")


def _check(repeats: int, out: Path | None, chart_option: str, chart: Path | None) -> None:
    """Refuse now what would fail after minutes of measuring."""
    if repeats < 1:
        raise InputError(f"--repeats: expected 1 or more, found {repeats}")
    if chart is not None and chart.suffix.lower() not in CHART_SUFFIXES:
        raise InputError(f"{chart_option}: expected a file named *{', *'.join(CHART_SUFFIXES)}, found {chart}")
    for path in filter(None, (out, chart)):
        if not path.absolute().parent.is_dir():
            raise InputError(f"{path}: expected a file in a folder that exists, found no folder {path.parent}")


def _write(out: Path | None, results: dict[str, Any]) -> None:
    """The results as JSON; before anything is printed, since a pipe may end early."""
    from clsplat.atomic import replacing

    if out is not None:
        with replacing(out) as file:
            file.write((json.dumps(results, indent=1) + "\n").encode())
        _say(f"results: {out}")


def _of_files(
    scene: Path | None, cameras: Path | None, views: int, downscale: Literal[1, 2, 4, 8]
) -> list[Workload] | None:
    """Workloads of --scene and --cameras; None where neither is given."""
    if (scene is None) != (cameras is None):
        raise InputError("--scene and --cameras: expected both or neither, found one of them")
    if scene is None or cameras is None:
        return None
    return from_files(scene, cameras, views, DataConfig(downscale=downscale))
