"""Sub-commands of `clsplat bench`: one dataclass each, from which tyro makes flags and help."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from clsplat.bench.workloads import (
    DEFAULT,
    FRAMES_DEFAULT,
    KNOBS_DEFAULT,
    Workload,
    from_files,
    scaling_names,
    synthetic,
)
from clsplat.config import UINT32_MAX, UINT64_MAX, Count, DataConfig, RenderConfig
from clsplat.errors import ClsplatError, InputError, new_folder
from clsplat.ranges import byte_size, within

if TYPE_CHECKING:
    from clsplat.bench.cells import Cell

CHART_SUFFIXES = (".png", ".svg", ".pdf")


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


@dataclass(frozen=True)
class Kernels:
    """Time a training step, its stages and their kernels, and compare them with the limits of the device."""

    workloads: tuple[str, ...] = DEFAULT
    """Synthetic scenes: number of Gaussians and image size."""
    scene: Path | None = None
    """File of Gaussians to time instead; requires --cameras."""
    cameras: Path | None = None
    """Dataset with the views for --scene, as for `train`."""
    views: Count = 1
    """Number of views of the dataset, evenly spread. Each is a workload."""
    downscale: Literal[1, 2, 4, 8] = 1
    """Divisor of the edges of the dataset's photos. `train` reduces large photos, and prints by how much."""
    scaling: Path | None = None
    """File for a chart of time against the numbers of Gaussians and pixels (.png, .svg, .pdf); its workloads are
    timed too."""
    repeats: Count = 15
    """Number of timed steps of each kind: whole, by stages, by kernels."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """JSON file for all results."""
    device: str | None = None
    """Part of the platform's or device's name."""
    render: Annotated[RenderConfig, tyro.conf.arg(name="")] = field(default_factory=RenderConfig)

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.kernel_report import details, networks, save_scaling_chart, summary
        from clsplat.bench.kernels import bench_kernels
        from clsplat.bench.time_model import LEAST_WORKLOADS
        from clsplat.bench.time_report import model_text
        from clsplat.device import Device, select_device

        check_files(self.out, "--scaling", self.scaling)
        workloads = self._workloads()
        device = Device(select_device(self.device))
        say(f"device: {device.label}")
        results = bench_kernels(workloads, self.render, device, self.repeats, lambda text: say(f"timing: {text}"))
        write_results(self.out, results)
        if self.scaling is not None:
            save_scaling_chart(results, self.scaling)
            say(f"chart: {self.scaling}")
        print(f"{summary(results)}\n\n{networks(results)}")
        for workload in results["workloads"]:
            print(f"\n{details(workload)}")
        if len(results["workloads"]) > LEAST_WORKLOADS:
            print(f"\n{model_text(results)}")

    def _workloads(self) -> list[Workload]:
        if self.scene is not None and self.scaling is not None:
            raise InputError("--scaling: expected synthetic workloads, found --scene; leave one of them out")
        names = [*self.workloads, *(scaling_names() if self.scaling is not None else ())]
        if not names and self.scene is None:
            raise InputError("--workloads: expected at least one, found none")
        return _of_files(self.scene, self.cameras, self.views, self.downscale) or [
            synthetic(name) for name in dict.fromkeys(names)
        ]


@dataclass(frozen=True)
class Viewer:
    """Time the frames of the viewer, while the camera moves and when it rests."""

    workloads: tuple[str, ...] = FRAMES_DEFAULT
    """Synthetic scenes: number of Gaussians and size of the window."""
    frames: Count = 30
    """Number of timed frames of each kind."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """JSON file for all results."""
    device: str | None = None
    """Part of the platform's or device's name."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.frame_rates import bench_frames, frames_text
        from clsplat.device import Device, select_device

        check_files(self.out, "--out", None)
        device = Device(select_device(self.device))
        say(f"device: {device.label}")
        workloads = [synthetic(name) for name in self.workloads]
        results = bench_frames(workloads, device, self.frames, lambda text: say(f"drawing: {text}"))
        write_results(self.out, results)
        print(frames_text(results))


@dataclass(frozen=True)
class Knobs:
    """Change each setting of the renderer, one at a time, and measure its time and error against the float64 twin."""

    workload: str = KNOBS_DEFAULT
    """Synthetic scene: number of Gaussians and image size."""
    scene: Path | None = None
    """File of Gaussians to use instead; requires --cameras."""
    cameras: Path | None = None
    """Dataset with the views for --scene, as for `train`."""
    views: Count = 1
    """Number of views of the dataset, evenly spread. Each is a workload."""
    downscale: Literal[1, 2, 4, 8] = 1
    """Divisor of the edges of the dataset's photos. `train` reduces large photos, and prints by how much."""
    repeats: Count = 7
    """Number of timed runs of each setting. They alternate with runs of the default."""
    chart: Path | None = None
    """File for a chart of error against time, for the first workload (.png, .svg, .pdf)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """JSON file for all results."""
    device: str | None = None
    """Part of the platform's or device's name."""
    render: Annotated[RenderConfig, tyro.conf.arg(name="")] = field(default_factory=RenderConfig)
    """The default that single settings are changed from."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.knob_report import knobs_text, save_knobs_chart
        from clsplat.bench.knobs import bench_knobs
        from clsplat.device import Device, select_device

        check_files(self.out, "--chart", self.chart)
        files = _of_files(self.scene, self.cameras, self.views, self.downscale)
        device = Device(select_device(self.device))
        say(f"device: {device.label}")
        workloads = files or [synthetic(self.workload)]
        results = bench_knobs(workloads, self.render, device, self.repeats, lambda text: say(f"turning: {text}"))
        write_results(self.out, results)
        if self.chart is not None:
            save_knobs_chart(results, self.chart)
            say(f"chart: {self.chart}")
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

        results, failed = measure_rows(self.names, Device(select_device(self.device)), self.out, say)
        print(table(results))
        if failed:
            raise ClsplatError(f"experiments failed, see above: {', '.join(failed)}")


@dataclass(frozen=True)
class Quality:
    """Train on scenes by several methods, and chart quality against time, Gaussians, bytes and memory."""

    data: tyro.conf.Positional[tuple[str, ...]]
    """Datasets, as for `train`. Options for reading the photos follow a colon: lego:background=white,
    fern:downscale=2. So do options for a variant: thin=4 (every 4th training photo), arc=0.2 (the end of the path is
    held out), points=0.1 (a tenth of the sparse points)."""
    methods: tuple[str, ...] = ("paper-7k", "auto")
    """Methods: auto (the default settings of `train`), its presets, radiance fields as for its --method, or
    configuration files as for its --config. What a file says of photos is ignored: it follows a dataset's name."""
    budgets: tuple[str, ...] = ("own",)
    """Caps on the number of Gaussians: "own" for the method's cap, a factor of it such as x0.5, or a number such as
    40000."""
    iterations: Annotated[tuple[int, ...], within(least=1, most=UINT32_MAX)] = ()
    """Numbers of iterations; default: that of each method."""
    seeds: Annotated[tuple[int, ...], within(least=0, most=UINT64_MAX)] = ()
    """Seeds, each of which repeats all trainings; default: that of each method."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("clsplat-quality")
    """Folder for results.jsonl and the charts. Finished trainings in it are not repeated; failed ones are."""
    device: str | None = None
    """Part of the platform's or device's name."""
    memory_limit: Annotated[str | None, byte_size()] = None
    """Largest device memory of a training, such as 4GB."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.cells import make_cells

        cells = make_cells(self.data, self.methods, self.budgets, self.iterations, self.memory_limit, self.seeds)
        _train(cells, self.device, self.out)
        Chart(self.out).run()


@dataclass(frozen=True)
class Captures:
    """Train on variants of scenes by several methods, to see which of them fit only the training photos.

    The variants are: the scene as it is; every 2nd, 4th and 8th training photo; the end of the path held out; a tenth
    of the sparse points.
    """

    data: tyro.conf.Positional[tuple[str, ...]]
    """Datasets, as for `train`; two or more for a choice by rotation. Options for reading the photos follow a colon:
    fern:downscale=4."""
    methods: tuple[str, ...] = ("paper-7k", "auto")
    """Methods: auto (the default settings of `train`), its presets, or configuration files as for its --config. What
    a file says of photos is ignored: it follows a dataset's name."""
    iterations: Annotated[tuple[int, ...], within(least=1, most=UINT32_MAX)] = ()
    """Numbers of iterations; default: that of each method."""
    seeds: Annotated[tuple[int, ...], within(least=0, most=UINT64_MAX)] = (0, 1)
    """Seeds. The noise of a figure comes from repetitions with several of them."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("clsplat-captures")
    """Folder for results.jsonl and captures.md. Finished trainings in it are not repeated; failed ones are."""
    device: str | None = None
    """Part of the platform's or device's name."""
    memory_limit: Annotated[str | None, byte_size()] = None
    """Largest device memory of a training, such as 4GB."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.atomic import replacing
        from clsplat.bench.captures_report import details, summary
        from clsplat.bench.cells import OWN, make_cells, standard_variants
        from clsplat.bench.quality_summary import origins
        from clsplat.bench.results import FILE, read_records

        data = [variant for text in self.data for variant in standard_variants(text)]
        _train(
            make_cells(data, self.methods, [OWN], self.iterations, self.memory_limit, self.seeds),
            self.device,
            self.out,
        )
        records = read_records(self.out / FILE)
        text = "\n".join(f"- {line}" for line in origins(records)) + f"\n\n{summary(records)}"
        with replacing(self.out / "captures.md") as file:
            file.write(f"{text}\n\n{details(records)}\n".encode())
        say(f"all captures: {self.out / 'captures.md'}")
        print(text)


def _train(cells: "list[Cell]", device_name: str | None, out: Path) -> None:
    """Run the trainings that are missing in the results in the folder `out`."""
    from clsplat.bench.quality import run_cells
    from clsplat.bench.results import FILE
    from clsplat.device import Device, select_device

    device = Device(select_device(device_name))
    say(f"device: {device.label}")
    new_folder(out)
    try:
        run_cells(cells, device, out / FILE, say)
    except KeyboardInterrupt:
        say(f"{out}: the same command continues after the last finished training")
        raise


@dataclass(frozen=True)
class Chart:
    """Draw the charts of `bench quality` from its results."""

    out: tyro.conf.Positional[Path]
    """Folder with results.jsonl. index.html and the charts, as PNG and SVG, are written to it."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.bench.charts_page import write_charts
        from clsplat.bench.results import FILE, read_records

        if not (self.out / FILE).is_file():
            raise InputError(f"{self.out}: expected a folder with {FILE}, which `bench quality` writes, found none")
        write_charts(read_records(self.out / FILE), self.out)
        say(f"charts: {self.out / 'index.html'}")


def check_files(out: Path | None, chart_option: str, chart: Path | None) -> None:
    """Check arguments that would otherwise fail after minutes of measuring."""
    if chart is not None and chart.suffix.lower() not in CHART_SUFFIXES:
        raise InputError(f"{chart_option}: expected a file named *{', *'.join(CHART_SUFFIXES)}, found {chart}")
    for path in filter(None, (out, chart)):
        if not path.absolute().parent.is_dir():
            raise InputError(f"{path}: expected a file in a folder that exists, found no folder {path.parent}")


def write_results(out: Path | None, results: dict[str, Any]) -> None:
    """Write the results as JSON. This happens before anything is printed, because a pipe may be closed early."""
    from clsplat.atomic import replacing

    if out is not None:
        with replacing(out) as file:
            file.write((json.dumps(results, indent=1) + "\n").encode())
        say(f"results: {out}")


def _of_files(
    scene: Path | None, cameras: Path | None, views: int, downscale: Literal[1, 2, 4, 8]
) -> list[Workload] | None:
    """Workloads of --scene and --cameras; None if neither is given."""
    if (scene is None) != (cameras is None):
        raise InputError("--scene and --cameras: expected both or neither, found one of them")
    if scene is None or cameras is None:
        return None
    return from_files(scene, cameras, views, DataConfig(downscale=downscale))
