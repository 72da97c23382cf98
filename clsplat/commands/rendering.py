"""The commands `eval` and `render`."""

import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from clsplat.commands.console import (
    Dataset,
    DeviceName,
    OptionalOut,
    SceneOrRun,
    moved,
    open_device,
    say,
    say_scores,
    try_folder,
    warn,
)
from clsplat.commands.options import CameraOptions, DrawOptions, PhotoOptions
from clsplat.commands.run_folders import dataset_of, place_of, scene_file, with_run
from clsplat.config import BACKGROUNDS
from clsplat.errors import InputError, named, new_folder
from clsplat.ranges import within

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from clsplat.camera import Camera
    from clsplat.render import Rendering
    from clsplat.scene import Scene
    from clsplat.surface import Surface

REDUCED = 8
"""Divisor of the edges of images that only tell whether a view shows anything."""


@dataclass(frozen=True)
class Eval:
    """Compare a scene with its held-out photos: metrics, and a page of pictures."""

    scene: SceneOrRun
    """File of Gaussians, or the folder of a run."""
    data: Dataset = None
    """Dataset, as for `train`. Default: the dataset of the run."""
    out: OptionalOut = None
    """Folder for metrics.json, index.html and the renders. Default: the folder `eval` of the run."""
    lpips: bool = False
    """Also compute LPIPS; needs the extra `lpips`, which imports torch, and AlexNet's weights in torch's cache."""
    device: DeviceName = None
    """Part of the name of the platform or device."""
    data_config: Annotated[PhotoOptions, tyro.conf.arg(name="")] = field(default_factory=PhotoOptions)
    render: Annotated[DrawOptions, tyro.conf.arg(name="")] = field(default_factory=DrawOptions)

    def base(self) -> "Eval | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self)

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset import load_scene_with_points
        from clsplat.evaluate import METRICS, evaluate
        from clsplat.formats import load_gaussians
        from clsplat.metrics import lpips, lpips_network
        from clsplat.render import renderings
        from clsplat.renderer import Renderer

        data, out = dataset_of("eval", self.data), place_of(self.out, self.scene, "eval")
        if self.lpips:
            lpips_network(False)  # refuses before any work
        try_folder(out)
        gaussians, mode, offset = load_gaussians(scene_file(self.scene))
        device = open_device(self.device)
        scene = load_scene_with_points(data, self.data_config, self.data_config.triangulate)
        if not scene.test:
            raise InputError(f"{data}: expected held-out photos to compare with, found none; see --test-every")
        gaussians = moved(gaussians, offset - scene.offset)
        new_folder(out)
        background = BACKGROUNDS[self.data_config.background]
        renderer = Renderer(device, replace(self.render, mode=mode), background)
        metrics = (*METRICS, lpips) if self.lpips else METRICS
        say_scores(evaluate(gaussians, scene.test, out, renderer, metrics), out)
        cameras = [view.camera for view in scene.test]
        small = [camera.resized(-(-camera.width // REDUCED), -(-camera.height // REDUCED)) for camera in cameras]
        warn_of_nothing([bool(each.alpha.any()) for each in renderings(renderer, gaussians, small, gradients=False)])


@dataclass(frozen=True)
class Render:
    """Render a scene to PNG files: the views of its held-out photos, or an orbit."""

    scene: SceneOrRun
    """File of Gaussians, or the folder of a run."""
    data: Dataset = None
    """Dataset, as for `train`; its cameras are the views, or determine the orbit. Default: the dataset of the run."""
    out: OptionalOut = None
    """Folder for the images. Default: the folder `render` of the run."""
    path: Literal["test", "orbit"] = "test"
    """test: the held-out views (all views if none is held out). orbit: a closed path around the scene."""
    frames: Annotated[int, within(least=1)] = 60
    """Number of images of an orbit."""
    depth: bool = False
    """Also write the expected depth, as 16-bit PNG scaled to the largest depth."""
    surface: bool = False
    """Also write the median depth, as 16-bit PNG scaled to the largest depth, and the normals, as PNG (red to the
    right, green up, blue to the camera)."""
    device: DeviceName = None
    """Part of the name of the platform or device."""
    data_config: Annotated[CameraOptions, tyro.conf.arg(name="")] = field(default_factory=CameraOptions)
    render: Annotated[DrawOptions, tyro.conf.arg(name="")] = field(default_factory=DrawOptions)

    def base(self) -> "Render | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self)

    def run(self) -> None:
        """Run the command."""
        from tqdm import tqdm

        from clsplat.dataset import load_scene_with_points
        from clsplat.formats import load_gaussians
        from clsplat.render import renderings
        from clsplat.renderer import Renderer

        data, out = dataset_of("render", self.data), place_of(self.out, self.scene, "render")
        try_folder(out)
        gaussians, mode, offset = load_gaussians(scene_file(self.scene))
        device = open_device(self.device)
        scene = load_scene_with_points(data, self.data_config, self.data_config.triangulate)
        gaussians = moved(gaussians, offset - scene.offset)
        endings = "", *["_depth"] * self.depth, *["_median", "_normals"] * self.surface
        cameras = self._cameras(scene, endings)
        new_folder(out)
        config = replace(self.render, mode=mode)
        background = BACKGROUNDS[self.data_config.background]

        renderer = Renderer(device, config, background)
        images = renderings(renderer, gaussians, cameras.values(), depth=self.depth, gradients=self.surface)
        # PNG compression takes as long as rendering, so that other threads do it at the same time.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            writing: deque[Future[None]] = deque()
            shown: list[bool] = []
            for (name, camera), rendering in tqdm(
                zip(cameras.items(), images, strict=True), unit="view", total=len(cameras)
            ):
                surface = rendering.surface() if self.surface else None
                shown.append(bool(rendering.alpha.any()))
                writing.append(pool.submit(write_maps, out / name, rendering, surface, camera))
                if len(writing) > 2 * (os.cpu_count() or 1):
                    writing.popleft().result()
            for image in writing:
                image.result()
        say(f"{out}: {len(cameras)} images")
        warn_of_nothing(shown)
        written = {f"{name}{ending}.png" for name in cameras for ending in endings}
        others = [name for path in out.rglob("*.png") if (name := path.relative_to(out).as_posix()) not in written]
        if others:
            warn(f"warning: {out}: also holds images of other commands ({named(sorted(others))})")

    def _cameras(self, scene: "Scene", endings: tuple[str, ...]) -> "dict[str, Camera]":
        """The cameras by the paths of their images without ``.png``, to which `endings` are added."""
        from clsplat.dataset.finding import without_suffix
        from clsplat.show.camera_paths import orbit
        from clsplat.show.picture_names import distinct_stems

        if self.path == "test":
            views = scene.test or scene.train
            stems = distinct_stems((without_suffix(view.name) for view in views), endings)
            return {stem: view.camera for stem, view in zip(stems, views, strict=True)}
        first = scene.train[0].camera
        path = orbit([view.camera for view in scene.train], self.frames, first.width, first.height)
        return {f"{i:04d}": camera for i, camera in enumerate(path)}


def warn_of_nothing(shown: list[bool]) -> None:
    """Warn if some views show nothing of a scene, as do cameras of another one; `shown` has a value for each view."""
    if not all(shown):
        count = f"{shown.count(False)} of {len(shown)}"
        warn(f"warning: {count} views show nothing of the scene; do the cameras belong to it?")


def write_maps(path: Path, rendering: "Rendering", surface: "Surface | None", camera: "Camera") -> None:
    """Write a rendering as PNG files: colours, the expected depth if it has one, and the surface's maps.

    `path` is that of the colours without ``.png``.
    """
    from PIL import Image

    from clsplat.atomic import replacing
    from clsplat.metrics import to_uint8
    from clsplat.show.frames import colored_normals, scaled_depth

    maps: dict[str, NDArray[Any]] = {"": to_uint8(rendering.rgb)}
    if rendering.depth is not None:
        maps["_depth"] = scaled_depth(rendering.depth)
    if surface is not None:
        maps["_median"] = scaled_depth(surface.depth)
        maps["_normals"] = colored_normals(surface.normals, camera)
    new_folder(path.parent)
    for ending, pixels in maps.items():
        with replacing(path.with_name(f"{path.name}{ending}.png")) as file:
            Image.fromarray(pixels).save(file, format="PNG")
