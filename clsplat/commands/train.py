"""The commands `train` and `demo`."""

import shlex
import signal
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from clsplat.commands import console
from clsplat.commands.console import (
    STARTED,
    Out,
    new_folder,
    open_device,
    say,
    say_cameras,
    say_scores,
    warn,
    write_json,
)
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.errors import InputError
from clsplat.training.presets import DATA_PATH, PRESETS, load_config, load_preset

if TYPE_CHECKING:
    from clsplat.device import Device
    from clsplat.gaussians import Gaussians
    from clsplat.scene import Scene
    from clsplat.show.viewer import Viewer


@dataclass(frozen=True)
class Train:
    """Train Gaussians on photos: a folder of them, a video, a COLMAP model with its photos, or a transforms.json."""

    data: tyro.conf.Positional[Path]
    """Folder of the dataset, or of photos alone; or a video, of which the sharpest two frames of each second are put
    into the folder `frames` of OUT (`clsplat frames` takes more or fewer)."""
    out: Out
    """Folder for the scene, its evaluation, checkpoint and log; or a file of Gaussians (*.spz, say) to write as well,
    whose name without the suffix becomes the folder."""
    resume: bool = False
    """Continue the interrupted run in OUT."""
    viewer: bool = False
    """Watch and pause the training in the browser; needs the extra `viewer`."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="|".join(PRESETS))] = None
    """A named set of settings to start from, in the place of the defaults; flags given beside it count."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The config.json of an earlier run, or a part of one, to start from; flags given beside it count."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def base(self) -> TrainConfig | None:
        """The settings that preset or file bring, in which flags are yet to be put; None where neither is given."""
        if self.preset is not None and self.config is not None:
            raise InputError("--preset and --config: expected one of them, found both")
        if self.preset is not None:
            return load_preset(self.preset)
        return None if self.config is None else load_config(self.config)

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset import load_scene, with_points
        from clsplat.dataset.video import extract_frames, is_video
        from clsplat.formats import save_gaussians, suffix_of
        from clsplat.training import few_views
        from clsplat.training.initialize import start_size
        from clsplat.training.loop import start_config
        from clsplat.training.memory import Footprint, parse_size

        suffix = "" if self.out.is_dir() else suffix_of(self.out)
        out = self.out.with_name(self.out.name[: -len(suffix)]) if suffix else self.out
        if not self.resume and (out / "checkpoint.npz").exists():
            raise InputError(
                f"{out}: holds a run already; --resume continues it, another folder after -o starts a new one"
            )
        config = self.settings
        if config.data.masks is not None:
            config = replace(config, data=replace(config.data, masks=str(Path(config.data.masks).resolve())))
        limit = None if config.memory_limit is None else parse_size(config.memory_limit, "--memory-limit")
        device = open_device(config.device, limit)
        data = self.data
        if is_video(data):
            data = out / "frames"
            say(f"{data}: {extract_frames(self.data, data)} frames of {self.data.name}")
        verbose = console.loudness == "verbose"
        scene = load_scene(data, config.data, verbose)
        say(f"scene: {len(scene.train)} photos to train on, {len(scene.test)} held out, {len(scene.points)} points")
        if config.init.triangulate and not len(scene.points) and not (out / "checkpoint.npz").exists():
            scene = with_points(scene, data, config.data, verbose)
            found = f"{len(scene.points)} points, from photos and poses" if len(scene.points) else "random"
            say(f"start: {found} (--init.no-triangulate: random)")
        adapted = few_views.adapted(config, scene)
        if adapted != config:
            config = adapted
            say(
                f"few views: with fewer than {config.few.below} photos Gaussians are fewer and simpler, and some are "
                "left out of each image (--few.below 0 trains as with many)"
            )
        need = Footprint.of(scene, config, device)
        start = start_size(scene, start_config(config), config.max_gaussians)
        say(need.describe(start, config.max_gaussians, device.memory_limit))
        new_folder(out)
        write_json(out / "config.json", {DATA_PATH: str(self.data.resolve()), **asdict(config)})
        say_cameras(data, out / "cameras.png")
        viewer = open_viewer(scene, config, device) if self.viewer else None
        try:
            gaussians = train_and_report(scene, config, device, out, self.resume, viewer)
        except KeyboardInterrupt:
            if (out / "checkpoint.npz").is_file():
                again = sys.argv[1:] + ([] if self.resume else ["--resume"])
                warn(f"to continue: {shlex.join(['clsplat', *again])}")
            raise
        if suffix:
            save_gaussians(self.out, gaussians, config.render.mode, scene.offset)
            say(f"{self.out}: {self.out.stat().st_size / 1e6:.3g} MB")
        if viewer:
            say(f"viewer: {viewer.address} stays open; Ctrl-C ends it")
            with suppress(KeyboardInterrupt):
                viewer.hold(gaussians)
            viewer.close()


def open_viewer(scene: "Scene", config: TrainConfig, device: "Device") -> "Viewer":
    """A viewer of a training, at its first photo."""
    from clsplat.show.camera_paths import first_photo
    from clsplat.show.viewer import Viewer

    if not scene.train:
        raise InputError("scene: expected at least one photo to train on, found none; lower --test-every")
    start = first_photo([view.camera for view in scene.train])
    background = BACKGROUNDS[config.data.background]
    viewer = Viewer(device, config.render, start, scene.train, background)
    say(f"viewer: open {viewer.address} in a browser")
    return viewer


def train_and_report(
    scene: "Scene", config: TrainConfig, device: "Device", out: Path, resume: bool, viewer: "Viewer | None" = None
) -> "Gaussians":
    """Train with a progress bar; write scene.ply, the evaluation and the training curve to `out`."""
    from tqdm import tqdm

    from clsplat.evaluate import evaluate, mean_metrics
    from clsplat.formats import save_gaussians
    from clsplat.pruning.prices import without_invisible
    from clsplat.show.training_curve import training_curve
    from clsplat.training.autosize.explanation import size_chart
    from clsplat.training.autosize.rule import can_search, split
    from clsplat.training.loop import train
    from clsplat.training.photo_poses import aligned

    background = BACKGROUNDS[config.data.background]
    interrupted = threading.Event()
    facts: dict[str, str] = {}  # what the viewer says beside its pictures

    def interrupt(*_: object) -> None:
        interrupted.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # the second Ctrl-C does not wait

    signal.signal(signal.SIGINT, interrupt)
    with tqdm(total=config.iterations, unit="it", dynamic_ncols=True) as bar:

        def progress(record: dict[str, Any]) -> None:
            if bar.n == 0:
                say(f"first iteration: done {time.perf_counter() - STARTED:.1f} s after the start")
            bar.update(record["iteration"] - bar.n)
            bar.set_postfix_str(f"loss={record['loss']:.4f}, N={record['num_gaussians']}", refresh=False)
            if viewer:
                facts["Iteration"] = f"{record['iteration']:,} of {config.iterations:,}"
                facts["Gaussians"], facts["Loss"] = f"{record['num_gaussians']:,}", f"{record['loss']:.4f}"
                viewer.tell(facts)
                viewer.follow(record["gaussians"], interrupted.is_set)
            if interrupted.is_set():
                warn(f"{out}: stopped after iteration {record['iteration']}")
                raise KeyboardInterrupt

        def held_out(gaussians: "Gaussians") -> dict[str, float]:
            means = mean_metrics(gaussians, scene.test, config.render, device, background)
            facts["Held-out photos"] = ", ".join(f"{name.upper()} {value:.4g}" for name, value in means.items())
            return means

        gaussians = train(
            scene, config, device, out, resume=resume, evaluate=held_out if scene.test else None, progress=progress
        )
    signal.signal(signal.SIGINT, signal.default_int_handler)
    gaussians = without_invisible(gaussians)
    save_gaussians(out / "scene.ply", gaussians, config.render.mode, scene.offset)
    say(f"{out / 'scene.ply'}: {len(gaussians)} Gaussians")
    training_curve(out / "log.jsonl", out / "training_curve.png")
    if config.size == "auto" and not can_search(scene.train):
        say(f"size: {len(scene.train)} photos are too few to choose it from; it is what the strategy made")
    elif config.size == "auto":
        size_chart(out / "size.json", out / "size.png")
        say(f"size: chosen from {len(split(scene.train)[1])} validation photos; {out / 'size.png'} shows why")
    if scene.test:
        report = evaluate(gaussians, scene.test, out / "eval", config.render, device, background=background)
        say_scores(report, out / "eval")
    if scene.test and config.poses:
        say("aligning the held-out photos' cameras with the scene")
        posed = [
            aligned(gaussians, view, scene.extent, config.optim, config.render, device, background)
            for view in scene.test
        ]
        report = evaluate(gaussians, posed, out / "eval_aligned", config.render, device, background=background)
        say_scores(report, out / "eval_aligned")
    return gaussians


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
        from clsplat.dataset import load_scene
        from clsplat.demo import make_photos
        from clsplat.render import render_views
        from clsplat.show.comparisons import side_by_side

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
