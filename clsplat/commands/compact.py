"""The command `compact`."""

import tempfile
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from clsplat.commands.console import DeviceName, Out, SceneOrRun, moved, open_device, say
from clsplat.commands.info import bytes_of
from clsplat.commands.options import DrawOptions, PhotoOptions
from clsplat.commands.run_folders import as_trained, is_run, read_run, scene_file, with_run
from clsplat.config import BACKGROUNDS
from clsplat.errors import InputError
from clsplat.ranges import byte_size, parse_bytes, within

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.pruning.compaction import Limits
    from clsplat.renderer import Renderer
    from clsplat.scene import Scene, View

HELD_OUT = 6
"""Spacing of the evaluation views, if the views have no held-out ones: every sixth view."""

MATCH_MIN = 15.0
"""Mean PSNR of a scene's renders against photos, dB, below which the photos hardly show this scene."""


@dataclass(frozen=True)
class Compact:
    """Make a scene smaller, within a loss of quality or a size of the file."""

    scene: SceneOrRun
    """File of Gaussians, or the folder of a run."""
    out: Out
    """File to write; its suffix determines the format."""
    max_gaussians: Annotated[int | None, within(least=1)] = None
    """Largest number of Gaussians."""
    max_bytes: Annotated[str | None, byte_size()] = None
    """Largest size of the file, such as 20MB."""
    max_psnr_loss: Annotated[float | None, within(above=0)] = None
    """Largest loss of PSNR, dB; the smallest file within it is chosen. The loss is measured in evaluation views,
    which do not influence what is removed."""
    cameras: Annotated[Path | None, tyro.conf.arg(metavar="DATASET")] = None
    """Dataset, as for `train`: the scene is compared with its own renders from the cameras of this dataset."""
    photos: Annotated[Path | None, tyro.conf.arg(metavar="DATASET")] = None
    """Dataset, as for `train`: the scene is compared with the photos of this dataset. Default: the dataset of the
    run. Without --cameras and --photos, viewpoints of a file are chosen automatically."""
    device: DeviceName = None
    """Part of the name of the platform or device."""
    data_config: Annotated[PhotoOptions, tyro.conf.arg(name="")] = field(default_factory=PhotoOptions)
    render: Annotated[DrawOptions, tyro.conf.arg(name="")] = field(default_factory=DrawOptions)

    def base(self) -> "Compact | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self, "photos" if self.cameras is None else "cameras")

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset import load_scene_with_points
        from clsplat.formats import FORMATS, load_gaussians, save_gaussians, suffix_of
        from clsplat.pruning.compaction import ASSUMED_PSNR, LossMeter, compact
        from clsplat.renderer import Renderer
        from clsplat.training.memory import bytes_text

        limits = self._limits()
        suffix = suffix_of(self.out)
        if suffix not in FORMATS or not self.out.absolute().parent.is_dir():  # checked now, not after minutes
            raise InputError(f"{self.out}: expected a file of Gaussians in a folder that exists; see docs/formats.md")
        if self.cameras is not None and self.photos is not None:
            raise InputError("--cameras, --photos: expected one of them, found both; --photos has cameras as well")
        source = scene_file(self.scene)
        gaussians, mode, offset = load_gaussians(source)
        device = open_device(self.device)
        background = BACKGROUNDS[self.data_config.background]
        renderer = Renderer(device, replace(self.render, mode=mode), background)
        scene = None
        dataset = self.photos or self.cameras
        if dataset is not None:
            scene = load_scene_with_points(dataset, self.data_config, self.data_config.triangulate)
            gaussians, offset = moved(gaussians, offset - scene.offset), scene.offset
            if self.photos is not None and is_run(self.scene):
                scene = as_trained(scene, self.scene, read_run(self.scene).config)
        pricing, evaluation = self._views(gaussians, scene, renderer)
        say(f"views: {len(pricing)} to price the Gaussians, {len(evaluation)} to measure the loss")
        loss = LossMeter(gaussians, evaluation, self.photos is not None, renderer)

        def stored(version: "Gaussians") -> "tuple[Gaussians, int]":
            with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the warnings for the final file are shown
                path = Path(folder) / f"scene{suffix}"
                save_gaussians(path, version, mode, offset)
                return load_gaussians(path)[0], path.stat().st_size

        found = compact(gaussians, pricing, loss, limits, stored, renderer)
        save_gaussians(self.out, found.gaussians, mode, offset)
        say(
            f"{self.scene}: {len(gaussians)} Gaussians of degree {gaussians.sh_degree}, "
            f"{bytes_text(bytes_of(source))}\n"
            f"{self.out}: {len(found.gaussians)} Gaussians of degree {found.gaussians.sh_degree}, "
            f"{bytes_text(self.out.stat().st_size)}"
        )
        if self.photos is not None:
            say(f"loss: {found.loss:.3f} dB of PSNR against the evaluation photos")
        else:
            say(f"loss: {found.loss:.3f} dB of PSNR, assuming {ASSUMED_PSNR:.0f} dB of the scene against photos")

    def _limits(self) -> "Limits":
        from clsplat.pruning.compaction import Limits

        size = None if self.max_bytes is None else parse_bytes(self.max_bytes, "--max-bytes")
        if self.max_gaussians is None and size is None and self.max_psnr_loss is None:
            raise InputError(
                "--max-gaussians, --max-bytes, --max-psnr-loss: expected at least one of these limits, found none"
            )
        return Limits(self.max_gaussians, size, self.max_psnr_loss)

    def _views(
        self, gaussians: "Gaussians", scene: "Scene | None", renderer: "Renderer"
    ) -> "tuple[list[View], list[View]]":
        """Choose the views that price the Gaussians and the evaluation views."""
        from clsplat.pruning.viewpoints import automatic_cameras, own_views

        if scene is None:
            cameras = automatic_cameras(gaussians, renderer)
            held_out: set[str] = set()
        else:
            cameras = {view.name: view.camera for view in scene.train + scene.test}
            held_out = {view.name for view in scene.test}
        views = own_views(gaussians, cameras, renderer)
        if len(views) < len(cameras):
            warnings.warn(f"{len(cameras) - len(views)} of {len(cameras)} views show nothing; left out", stacklevel=2)
        if self.photos is not None and scene is not None:
            showing = {view.name for view in views}
            own, views = views, [view for view in scene.train + scene.test if view.name in showing]
            self._check_photos(own, views)
        held_out = held_out or {view.name for view in views[::HELD_OUT]}
        pricing = [view for view in views if view.name not in held_out]
        evaluation = [view for view in views if view.name in held_out]
        if not pricing or not evaluation:
            where = self.photos or self.cameras or "automatic viewpoints"
            raise InputError(
                f"{where}: expected a view of the scene to price the Gaussians and another one to measure the loss, "
                f"found {len(pricing)} and {len(evaluation)} of {len(cameras)}; do the cameras belong to "
                f"{self.scene}?"
            )
        return pricing, evaluation

    def _check_photos(self, own: "list[View]", photos: "list[View]") -> None:
        """Warn if the photos hardly show this scene."""
        import numpy as np

        from clsplat.metrics import psnr

        found = [psnr(render.image, photo.image, photo.mask) for render, photo in zip(own, photos, strict=True)]
        if found and np.mean(found) < MATCH_MIN:
            warnings.warn(
                f"{self.photos}: the scene matches the photos with only {np.mean(found):.1f} dB; do they show it?",
                stacklevel=2,
            )
