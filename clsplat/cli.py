"""The command line: a dataclass per command; tyro makes flags and help of its fields."""

import json
import os
import signal
import sys
import threading
import time
import warnings
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from clsplat.bench.commands import Kernels
from clsplat.config import BACKGROUNDS, DataConfig, RenderConfig, SfmConfig, TrainConfig
from clsplat.errors import ClsplatError, InputError

if TYPE_CHECKING:
    from clsplat.device import Device
    from clsplat.gaussians import Gaussians
    from clsplat.scene import Scene

STARTED = time.perf_counter()  # of the command, but for the 0.2 s that Python takes to get here

Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]


def say(text: str) -> None:
    """Tell the user, beside the progress bars."""
    print(text, file=sys.stderr, flush=True)


def open_device(name: str | None, memory_limit: int | None = None) -> "Device":
    """The device the user asked for, named."""
    from clsplat.device import Device, select_device

    device = Device(select_device(name), memory_limit=memory_limit)
    say(f"device: {device.label}")
    return device


def new_folder(out: Path) -> None:
    """Create a folder, or say why it cannot be."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a folder that can be made, found: {error.strerror or error}") from error


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, whole or not at all."""
    from clsplat.io.atomic import replacing

    with replacing(path) as file:
        file.write((json.dumps(value, indent=2) + "\n").encode())


@dataclass(frozen=True)
class Devices:
    """List the OpenCL devices, what each can do, and the one that would be taken."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.device import device_label, list_devices, select_device

        default = select_device()
        for device in list_devices():
            extensions = device.extensions
            abilities = [
                f"{device.max_compute_units} compute units",
                f"{device.global_mem_size / 2**30:.1f} GiB, {device.max_mem_alloc_size / 2**30:.1f} GiB per buffer",
                f"{device.local_mem_size // 1024} KiB local",
                device.version.strip(),
                "double precision" if "cl_khr_fp64" in extensions else "no double precision",
                "subgroups" if "subgroups" in extensions else "no subgroups",
            ]
            print(f"{'*' if device == default else ' '} {device_label(device)}\n    {'; '.join(abilities)}")
        print("* is taken by default; choose another by part of its name: --device NAME, or by PYOPENCL_CTX")


@dataclass(frozen=True)
class Sfm:
    """Recover the cameras of a folder of photos (pycolmap); `train` does so by itself where it is needed."""

    photos: tyro.conf.Positional[Path]
    """Folder of photos."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for the model; default: beside the photos."""
    sfm: Annotated[SfmConfig, tyro.conf.arg(name="")] = field(default_factory=SfmConfig)

    def run(self) -> None:
        """Run the command."""
        from clsplat.sfm import reconstruct

        print(reconstruct(self.photos, self.sfm, self.out))


@dataclass(frozen=True)
class Train:
    """Train Gaussians on photos: a folder of photos, a COLMAP model with its photos, or a transforms.json."""

    data: tyro.conf.Positional[Path]
    """Folder of the dataset, or of photos alone."""
    out: Out
    """Folder for the scene, its evaluation, checkpoint and log; or a file of Gaussians (*.spz, say) to write as well,
    whose name without the suffix becomes the folder."""
    resume: bool = False
    """Continue the interrupted run in OUT."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def run(self) -> None:
        """Run the command."""
        from clsplat.io import load_scene, save_gaussians, suffix_of
        from clsplat.memory import Footprint, parse_size

        suffix = "" if self.out.is_dir() else suffix_of(self.out)
        out = self.out.with_name(self.out.name[: -len(suffix)]) if suffix else self.out
        if not self.resume and (out / "checkpoint.npz").exists():
            raise InputError(
                f"{out}: holds a run already; --resume continues it, another folder after -o starts a new one"
            )
        config = self.config
        if config.data.masks is not None:
            config = replace(config, data=replace(config.data, masks=str(Path(config.data.masks).resolve())))
        limit = None if config.memory_limit is None else parse_size(config.memory_limit, "--memory-limit")
        device = open_device(config.device, limit)
        scene = load_scene(self.data, config.data)
        say(f"scene: {len(scene.train)} photos to train on, {len(scene.test)} held out, {len(scene.points)} points")
        need = Footprint.of(scene, config, device)
        start = len(scene.points) or config.init.random_points
        say(need.describe(start, config.adc.max_gaussians, device.memory_limit))
        new_folder(out)
        write_json(out / "config.json", {"data_path": str(self.data.resolve()), **asdict(config)})
        gaussians = train_and_report(scene, config, device, out, self.resume)
        if suffix:
            save_gaussians(self.out, gaussians, config.render.mode, scene.offset)
            say(f"{self.out}: {self.out.stat().st_size / 1e6:.3g} MB")


def train_and_report(scene: "Scene", config: TrainConfig, device: "Device", out: Path, resume: bool) -> "Gaussians":
    """Train with a progress bar; write scene.ply, the evaluation and the training curve to `out`."""
    from tqdm import tqdm

    from clsplat.evaluate import evaluate, mean_metrics
    from clsplat.io import save_gaussians
    from clsplat.report import training_curve
    from clsplat.train import train

    background = BACKGROUNDS[config.data.background]
    interrupted = threading.Event()

    def interrupt(*_: object) -> None:
        interrupted.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # the second Ctrl-C does not wait

    signal.signal(signal.SIGINT, interrupt)
    with tqdm(total=config.iterations, unit="it", dynamic_ncols=True) as bar:

        def progress(record: dict[str, Any]) -> None:
            if bar.n == 0:
                bar.write(f"first iteration: done {time.perf_counter() - STARTED:.1f} s after the start", sys.stderr)
            bar.update(record["iteration"] - bar.n)
            if interrupted.is_set():
                say(f"\n{out}: stopped after iteration {record['iteration']}; --resume continues from there")
                raise KeyboardInterrupt
            bar.set_postfix_str(f"loss={record['loss']:.4f}, N={record['num_gaussians']}", refresh=False)

        def held_out(gaussians: "Gaussians") -> dict[str, float]:
            return mean_metrics(gaussians, scene.test, config.render, device, background)

        gaussians = train(
            scene, config, device, out, resume=resume, evaluate=held_out if scene.test else None, progress=progress
        )
    signal.signal(signal.SIGINT, signal.default_int_handler)
    save_gaussians(out / "scene.ply", gaussians, config.render.mode, scene.offset)
    say(f"{out / 'scene.ply'}: {len(gaussians)} Gaussians")
    training_curve(out / "log.jsonl", out / "training_curve.png")
    if scene.test:
        report = evaluate(gaussians, scene.test, out / "eval", config.render, device, background=background)
        say_scores(report, out / "eval")
    return gaussians


def say_scores(report: dict[str, Any], out: Path) -> None:
    """Tell the mean figures and where the page is."""
    mean = ", ".join(f"{name.upper()} {value:.4g}" for name, value in report["mean"].items() if value is not None)
    say(f"held-out photos: {mean}; page: {out / 'index.html'}")


@dataclass(frozen=True)
class Eval:
    """Compare renders of a scene with the held-out photos: metrics as JSON, and a page of pictures."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    data: tyro.conf.Positional[Path]
    """Dataset, as given to `train`."""
    out: Out
    """Folder for metrics.json, index.html and the renders."""
    device: str | None = None
    """Part of the platform's or device's name."""
    data_config: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    render: Annotated[RenderConfig, tyro.conf.arg(name="")] = field(default_factory=RenderConfig)

    def run(self) -> None:
        """Run the command."""
        from clsplat.evaluate import evaluate
        from clsplat.io import load_gaussians, load_scene

        gaussians, mode, offset = load_gaussians(self.scene)
        device = open_device(self.device)
        scene = load_scene(self.data, self.data_config)
        if not scene.test:
            raise InputError(f"{self.data}: expected held-out photos to compare with, found none; see --test-every")
        gaussians = moved(gaussians, offset - scene.offset)
        new_folder(self.out)
        background = BACKGROUNDS[self.data_config.background]
        config = replace(self.render, mode=mode)
        say_scores(evaluate(gaussians, scene.test, self.out, config, device, background=background), self.out)


def moved(gaussians: "Gaussians", by: Any) -> "Gaussians":
    """The Gaussians translated by `by` (3,), in float64 until the end."""
    return replace(gaussians, means=(gaussians.means + by).astype(gaussians.means.dtype))


@dataclass(frozen=True)
class Render:
    """Render a scene as PNG files: the held-out views of its dataset, or an orbit around what its photos show."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    data: tyro.conf.Positional[Path]
    """Dataset, as given to `train`; its cameras are the views or lead the orbit."""
    out: Out
    """Folder for the pictures."""
    path: str = "test"
    """test: the held-out views (all views, where none is held out). orbit: a closed path around the scene."""
    frames: int = 60
    """Pictures of an orbit."""
    depth: bool = False
    """Also write the expected depth, as 16-bit PNG scaled to the largest depth."""
    device: str | None = None
    """Part of the platform's or device's name."""
    data_config: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    render: Annotated[RenderConfig, tyro.conf.arg(name="")] = field(default_factory=RenderConfig)

    def run(self) -> None:
        """Run the command."""
        import numpy as np
        from PIL import Image
        from tqdm import tqdm

        from clsplat.io import load_gaussians, load_scene
        from clsplat.io.atomic import replacing
        from clsplat.metrics import to_uint8
        from clsplat.orbit import orbit
        from clsplat.render import Rendering, render_views

        if self.path not in ("test", "orbit"):
            raise InputError(f"--path: expected test or orbit, found {self.path!r}")
        gaussians, mode, offset = load_gaussians(self.scene)
        device = open_device(self.device)
        scene = load_scene(self.data, self.data_config)
        gaussians = moved(gaussians, offset - scene.offset)
        views = scene.test or scene.train
        if self.path == "test":
            cameras = {view.name: view.camera for view in views}
        else:
            first = scene.train[0].camera
            path = orbit([view.camera for view in scene.train], self.frames, first.width, first.height)
            cameras = {f"{i:04d}": camera for i, camera in enumerate(path)}
        new_folder(self.out)
        config = replace(self.render, mode=mode)
        background = BACKGROUNDS[self.data_config.background]

        def write(name: str, rendering: Rendering) -> None:
            target = (self.out / name).with_suffix(".png")
            new_folder(target.parent)
            with replacing(target) as file:
                Image.fromarray(to_uint8(rendering.rgb)).save(file, format="PNG")
            if rendering.depth is not None:
                depth = rendering.depth / max(float(rendering.depth.max()), 1e-12) * 65535
                with replacing(target.with_name(f"{target.stem}_depth.png")) as file:
                    Image.fromarray(np.rint(depth).astype(np.uint16)).save(file, format="PNG")

        renderings = render_views(
            gaussians, cameras.values(), config, device, background=background, depth=self.depth
        )
        # PNG compression takes as long as rendering: it runs beside it, a few pictures behind.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            writing: deque[Future[None]] = deque()
            for name, rendering in tqdm(zip(cameras, renderings, strict=True), unit="view", total=len(cameras)):
                writing.append(pool.submit(write, name, rendering))
                if len(writing) > 2 * (os.cpu_count() or 1):
                    writing.popleft().result()
            for picture in writing:
                picture.result()
        say(f"{self.out}: {len(cameras)} pictures")


@dataclass(frozen=True)
class Export:
    """Convert a file of Gaussians; formats are told by the suffix."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    out: Out
    """File to write."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.io import load_gaussians, save_gaussians

        gaussians, mode, offset = load_gaussians(self.scene)
        save_gaussians(self.out, gaussians, mode, offset)
        say(f"{self.out}: {len(gaussians)} Gaussians")


@dataclass(frozen=True)
class Demo:
    """Make photos of a still life, recover their cameras, train, evaluate: the whole path in minutes."""

    out: Out = Path("clsplat-demo")
    """Folder for everything that is made."""
    iterations: int = 1500
    """Optimisation steps."""
    device: str | None = None
    """Part of the platform's or device's name."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.demo import make_photos
        from clsplat.io import load_scene
        from clsplat.render import render_views
        from clsplat.report import side_by_side

        if self.out.exists() and any(self.out.iterdir()):
            raise InputError(f"{self.out}: expected an empty or new folder for the demo; choose another with -o")
        started = time.perf_counter()
        device = open_device(self.device)
        photos = self.out / "photos"
        new_folder(photos)
        say("photos: ray tracing a still life")
        make_photos(photos)
        say("cameras: structure from motion on the photos alone")
        config = TrainConfig(iterations=self.iterations, eval_every=max(1, self.iterations // 7), device=self.device)
        scene = load_scene(photos, config.data)
        say(f"scene: {len(scene.train)} photos to train on, {len(scene.test)} held out, {len(scene.points)} points")
        write_json(self.out / "config.json", asdict(config))
        gaussians = train_and_report(scene, config, device, self.out, resume=False)
        renderings = render_views(gaussians, [view.camera for view in scene.test], config.render, device)
        pairs = [(view.image, rendering.rgb) for view, rendering in zip(scene.test, renderings, strict=True)]
        side_by_side(self.out / "side_by_side.png", pairs)
        say(
            f"done in {time.perf_counter() - started:.0f} s. Look at {self.out / 'side_by_side.png'} (photo and "
            f"render), {self.out / 'training_curve.png'} and {self.out / 'eval' / 'index.html'}; "
            f"{self.out / 'scene.ply'} has the format that splat viewers read."
        )


# tyro makes sub-commands of a union; the hidden member makes one of a single class.
BENCHMARKS = Annotated[Kernels, tyro.conf.subcommand("kernels")] | Annotated[None, tyro.conf.Suppress]


@dataclass(frozen=True)
class Bench:
    """Measure this installation on this machine."""

    what: Annotated[BENCHMARKS, tyro.conf.arg(name="")]
    """What to measure."""

    def run(self) -> None:
        """Run the command."""
        if self.what is not None:
            self.what.run()


COMMANDS = Devices | Sfm | Train | Eval | Render | Export | Demo | Bench


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``clsplat``: errors that are the user's to mend print one sentence and exit with 2."""
    warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}")
    command = tyro.cli(
        COMMANDS, prog="clsplat", args=arguments, description="3D Gaussian Splatting on any OpenCL device."
    )
    try:
        command.run()
    except ClsplatError as error:
        say(f"clsplat: {error}")
        sys.exit(2)
    except OSError as error:  # what no reader or writer has put in words: a disk that fills up under a log, say
        say(f"clsplat: {error.filename or 'input or output'}: {error.strerror or error}")
        sys.exit(2)
    except KeyboardInterrupt:
        say("clsplat: interrupted")
        sys.exit(130)
