"""The command `train`."""

import shlex
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from clsplat.commands import console
from clsplat.commands.blockwise import JobsPrinted, train_in_blocks
from clsplat.commands.console import (
    Out,
    picture_cameras,
    say,
    say_cameras,
    say_scores,
    try_folder,
    warn,
    write_json,
)
from clsplat.commands.options import ClusterOptions, ServerOptions
from clsplat.commands.progress import train_with_progress
from clsplat.commands.run_folders import (
    CONFIG,
    SCENE,
    MethodName,
    began,
    check_apart,
    check_method,
    check_new,
    extracted,
    photos_of,
    read_config,
)
from clsplat.commands.viewing import open_viewer
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.errors import InputError
from clsplat.training.presets import DATA_PATH, PRESETS, load_config, load_preset

if TYPE_CHECKING:
    from clsplat.device import Device
    from clsplat.gaussians import Gaussians
    from clsplat.render import Stored
    from clsplat.renderer import Renderer
    from clsplat.scene import Scene
    from clsplat.show.viewer import Viewer


@dataclass(frozen=True)
class Train:
    """Train Gaussians on photos, a video, a COLMAP model with its photos, or a transforms.json."""

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS|VIDEO|DATASET")]
    """Folder of photos, with or without cameras, or a video. The sharpest frame of each half second of a video is
    written to the folder `frames` of OUT (`clsplat frames` takes more or fewer)."""
    out: Out
    """Folder for the scene, its evaluation, checkpoint and log; or a file of Gaussians, such as scene.spz, which is
    written as well; its name without the suffix becomes the folder."""
    method: MethodName = "gaussians"
    """Gaussians or a radiance field. A field has only these settings: --iterations, --seed, those of the photos, of
    evaluations and of checkpoints, --device and --memory-limit."""
    resume: bool = False
    """Continue the interrupted run in OUT."""
    viewer: bool = False
    """Watch and pause the training in the browser (--open also opens it); needs the extra `viewer`."""
    server: Annotated[ServerOptions, tyro.conf.arg(name="")] = field(default_factory=ServerOptions)
    cluster: Annotated[ClusterOptions, tyro.conf.arg(name="")] = field(default_factory=ClusterOptions)
    preset: Annotated[str | None, tyro.conf.arg(metavar="|".join(PRESETS))] = None
    """Named settings to start from instead of the defaults; flags override them."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A run's config.json, or a part of one, to start from; flags override it."""
    settings: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def base(self) -> "Train | None":
        """The command with the settings of the preset or the file, before flags override them; None without them."""
        if self.preset is not None and self.config is not None:
            raise InputError("--preset and --config: expected one of them, found both")
        if self.preset is not None:
            return replace(self, settings=load_preset(self.preset))
        if self.config is None:
            return None
        given = read_config(self.config)
        return replace(self, method=given.method or self.method, settings=given.config)

    def run(self) -> None:
        """Run the command."""
        from clsplat.formats import check_writable, suffix_of
        from clsplat.training.checkpoint import no_checkpoint
        from clsplat.training.run_folder import held

        suffix = "" if self.out.is_dir() else suffix_of(self.out)
        out = self.out.with_name(self.out.name[: -len(suffix)]) if suffix else self.out
        if suffix:
            check_writable(self.out)
        if suffix and self.out.exists() and not self.resume:
            raise InputError(f"{self.out}: expected a new file, found one that exists; choose another name with -o")
        if self.resume and not began(out):
            raise no_checkpoint(out)
        if self.resume:
            check_method(out, self.method)
        else:
            check_apart(self.data, out, self.settings.data)
        if self.method != "gaussians":
            train_method(self, out, suffix)
            return
        self._check()
        with held(out):
            try:
                gaussians, viewer = self.trained(out, suffix)
            except JobsPrinted:
                say("when these commands have run, repeat this command with --resume")
                return
        if viewer and gaussians is not None:
            say(f"viewer: {viewer.address} stays open; Ctrl-C ends it")
            with suppress(KeyboardInterrupt):
                viewer.hold(gaussians)
            viewer.close()

    def _check(self) -> None:
        """Refuse settings that exclude each other before anything takes time."""
        from clsplat.blocks.settings import check_blocks
        from clsplat.training.preparation import check_settings

        check_settings(self.settings)
        if self.settings.blocks == 1 and self.cluster != ClusterOptions():
            raise InputError("--scheduler, --print-jobs: expected with --blocks, found --blocks 1; add --blocks auto")
        if self.settings.blocks != 1:
            check_blocks(self.settings)
            if self.viewer or self.server.open:
                raise InputError("--viewer: expected a training without --blocks, found both; leave out one of them")

    def trained(self, out: Path, suffix: str) -> "tuple[Gaussians | None, Viewer | None]":
        """Train in a folder that is held; if `suffix` is not empty, also write a file of Gaussians."""
        from clsplat.formats import load_gaussians, save_gaussians

        check_new(out, self.resume)
        try_folder(out)
        viewer = open_viewer(self.server) if self.viewer or self.server.open else None
        try:
            device = open_and_name(self.settings)
            scene, config = self.prepared(out, device, viewer)
            gaussians = self._trained(scene, config, device, out, viewer)
        except BaseException as error:
            if viewer:
                viewer.close()
            if isinstance(error, (KeyboardInterrupt, MemoryError)) and began(out):
                again = sys.argv[1:] + ([] if self.resume else ["--resume"])
                warn(f"to continue: {shlex.join(['clsplat', *again])}")
            raise
        if suffix:
            gaussians = load_gaussians(out / SCENE)[0] if gaussians is None else gaussians
            save_gaussians(self.out, gaussians, config.render.mode, scene.offset)
            say(f"{self.out}: {self.out.stat().st_size / 1e6:.3g} MB")
        return gaussians, viewer

    def _trained(
        self, scene: "Scene", config: TrainConfig, device: "Device", out: Path, viewer: "Viewer | None"
    ) -> "Gaussians | None":
        """Train the whole scene; or return None after training in blocks, if the settings ask for more than one."""
        from clsplat.renderer import Renderer
        from clsplat.resuming import CHECKPOINT

        if config.blocks != 1:
            renderer = Renderer(device, config.render, BACKGROUNDS[config.data.background])
            if stored := train_in_blocks(scene, config, renderer, photos_of(self.data, out), out, self.cluster):
                self._began(out)()
                report(stored, scene, config, renderer, out)
                return None
            config = replace(config, blocks=1)
        resume = self.resume and (out / CHECKPOINT).exists()
        return train_and_report(scene, config, device, out, resume, viewer, self._began(out))

    def _began(self, out: Path) -> Callable[[], None]:
        """Return a function that draws the recovered cameras, to run after the first step, for which a user waits."""

        def draw() -> None:
            if not self.resume:
                picture_cameras(photos_of(self.data, out), out / "cameras.png")

        return draw

    def prepared(self, out: Path, device: "Device", viewer: "Viewer | None") -> "tuple[Scene, TrainConfig]":
        """Prepare scene and configuration, and check that they fit the device.

        The configuration is written to `out`, unless a run resumes: it keeps the one that it was started with, and
        `train` compares them.
        """
        from clsplat.training.checkpoint import demand_same
        from clsplat.training.loop import check
        from clsplat.training.preparation import prepare

        def tell(text: str) -> None:
            say(text)
            if viewer:
                viewer.wait(text)

        if viewer:
            viewer.wait("reading the photos, and recovering their cameras if they have none")
        data = extracted(self.data, out)
        scene, config = prepare(
            data,
            self.settings,
            device,
            verbose=console.loudness == "verbose",
            tell=tell,
        )
        check(scene, config)
        if self.resume and config.blocks != 1:
            demand_same(load_config(out / CONFIG), config, out / CONFIG)
        if not self.resume:
            write_json(out / CONFIG, {DATA_PATH: str(self.data.resolve()), **asdict(config)})
            say_cameras(data)
        return scene, config


def train_method(command: Train, out: Path, suffix: str) -> None:
    """Train a radiance field in a folder, and evaluate it."""
    from clsplat.commands.fields import check_settings, train_and_evaluate
    from clsplat.training.run_folder import held

    refused = {
        f"-o {command.out}": bool(suffix),
        "--viewer or --open": command.viewer or command.server.open,
        "--scheduler or --print-jobs": command.cluster != ClusterOptions(),
    }
    if found := [flags for flags, given in refused.items() if given]:
        raise InputError(
            f"--method {command.method}: expected a folder after -o, no viewer and no blocks, found {found[0]}"
        )
    check_settings(command.method, command.settings)
    with held(out):
        check_new(out, command.resume)
        try_folder(out)
        device = open_and_name(command.settings)
        train_and_evaluate(command.data, command.method, command.settings, device, out, command.resume)


def open_and_name(config: TrainConfig) -> "Device":
    """Open the device of a configuration, and report its name."""
    from clsplat.training.preparation import open_device

    device = open_device(config)
    say(f"device: {device.label}")
    return device


def train_and_report(
    scene: "Scene",
    config: TrainConfig,
    device: "Device",
    out: Path,
    resume: bool,
    viewer: "Viewer | None" = None,
    began: Callable[[], None] = lambda: None,
) -> "Gaussians":
    """Train with a progress bar; write scene.ply, the evaluation and the training curve to `out`.

    `began` is called after the first step.
    """
    from clsplat.formats import save_gaussians
    from clsplat.renderer import Renderer

    renderer = Renderer(device, config.render, BACKGROUNDS[config.data.background])
    gaussians = train_with_progress(scene, config, renderer, out, resume, viewer, began)
    save_gaussians(out / SCENE, gaussians, config.render.mode, scene.offset)
    report(gaussians, scene, config, renderer, out)
    return gaussians


def report(
    gaussians: "Gaussians | Stored", scene: "Scene", config: TrainConfig, renderer: "Renderer", out: Path
) -> None:
    """Write the evaluation and the training curve of a training that has ended to `out`, which has its scene."""
    from clsplat.show.training_curve import training_curve
    from clsplat.training.outcome import failure

    say(f"{out / SCENE}: {len(gaussians)} Gaussians")
    scene = say_moving(scene, out)
    failed = failure(gaussians, scene.train, renderer)
    if failed:
        warn(failed)
    training_curve(out / "log.jsonl", out / "training_curve.png")
    if config.size == "auto" and config.blocks == 1:  # blocks do not search
        say_size(scene, out)
    if scene.test:
        evaluate_held_out(gaussians, scene, config, renderer, out)


def say_moving(scene: "Scene", out: Path) -> "Scene":
    """Report what training has left out because it moves, and draw it. Returns the scene without it."""
    from clsplat.show.moving_sheet import moving_sheet
    from clsplat.training.moving import still
    from clsplat.training.moving_files import load_masks

    if not (found := load_masks(out)):
        return scene
    moving_sheet(out / "moving.png", scene.train, found)
    say(
        f"moving: {len(found)} of {len(scene.train)} training photos show what the others contradict, such as people "
        f"who walk by; it was left out ({out / 'moving.png'} shows where, --no-mask-moving trains on all)"
    )
    return replace(scene, train=still(scene.train, found))


def say_size(scene: "Scene", out: Path) -> None:
    """Report how the number of Gaussians was chosen, and draw it."""
    from clsplat.training.autosize.explanation import size_chart
    from clsplat.training.autosize.validation import can_validate, split

    if not can_validate(scene.train):
        say(f"size: {len(scene.train)} photos are too few to choose it from; it is what the strategy made")
        return
    size_chart(out / "size.json", out / "size.png")
    say(f"size: chosen by {len(split(scene.train)[1])} photos that were held back; {out / 'size.png'} shows why")


def evaluate_held_out(
    gaussians: "Gaussians | Stored", scene: "Scene", config: TrainConfig, renderer: "Renderer", out: Path
) -> None:
    """Evaluate the held-out photos; if poses were refined, also with the photos' cameras aligned with the scene."""
    from clsplat.commands.generalisation import generalisation
    from clsplat.evaluate import evaluate
    from clsplat.gaussians import Gaussians
    from clsplat.training.photo_poses import aligned

    report = evaluate(gaussians, scene.test, out / "eval", renderer)
    say_scores(report, out / "eval")
    if config.poses and isinstance(gaussians, Gaussians):  # blocks refuse --poses
        say("aligning the held-out photos' cameras with the scene")
        posed = [aligned(gaussians, view, scene.extent, config.optim, renderer) for view in scene.test]
        report = evaluate(gaussians, posed, out / "eval_aligned", renderer)
        say_scores(report, out / "eval_aligned")
    say(f"generalisation: {generalisation(gaussians, scene, report, renderer, config.exposure)}")
