"""The commands `eval` and `render`."""

import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import tyro

from clsplat.commands.console import (
    Dataset,
    DeviceName,
    OptionalOut,
    SceneOrRun,
    moved,
    new_folder,
    open_device,
    say,
    say_scores,
    try_folder,
)
from clsplat.commands.options import CameraOptions, DrawOptions, PhotoOptions
from clsplat.commands.run_folders import dataset_of, place_of, scene_file, with_run
from clsplat.config import BACKGROUNDS
from clsplat.errors import InputError
from clsplat.ranges import within


@dataclass(frozen=True)
class Eval:
    """Compare a scene with its held-out photos: metrics, and a page of pictures."""

    scene: SceneOrRun
    """File of Gaussians, or the folder of a run."""
    data: Dataset = None
    """Dataset, as for `train`. Default: the dataset of the run."""
    out: OptionalOut = None
    """Folder for metrics.json, index.html and the renders. Default: the folder `eval` of the run."""
    device: DeviceName = None
    """Part of the name of the platform or device."""
    data_config: Annotated[PhotoOptions, tyro.conf.arg(name="")] = field(default_factory=PhotoOptions)
    render: Annotated[DrawOptions, tyro.conf.arg(name="")] = field(default_factory=DrawOptions)

    def base(self) -> "Eval | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self)

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset import load_scene
        from clsplat.evaluate import evaluate
        from clsplat.formats import load_gaussians
        from clsplat.renderer import Renderer

        data, out = dataset_of("eval", self.data), place_of(self.out, self.scene, "eval")
        try_folder(out)
        gaussians, mode, offset = load_gaussians(scene_file(self.scene))
        device = open_device(self.device)
        scene = load_scene(data, self.data_config)
        if not scene.test:
            raise InputError(f"{data}: expected held-out photos to compare with, found none; see --test-every")
        gaussians = moved(gaussians, offset - scene.offset)
        new_folder(out)
        background = BACKGROUNDS[self.data_config.background]
        renderer = Renderer(device, replace(self.render, mode=mode), background)
        say_scores(evaluate(gaussians, scene.test, out, renderer), out)


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
    device: DeviceName = None
    """Part of the name of the platform or device."""
    data_config: Annotated[CameraOptions, tyro.conf.arg(name="")] = field(default_factory=CameraOptions)
    render: Annotated[DrawOptions, tyro.conf.arg(name="")] = field(default_factory=DrawOptions)

    def base(self) -> "Render | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self)

    def run(self) -> None:
        """Run the command."""
        import numpy as np
        from PIL import Image
        from tqdm import tqdm

        from clsplat.atomic import replacing
        from clsplat.dataset import load_scene
        from clsplat.formats import load_gaussians
        from clsplat.metrics import to_uint8
        from clsplat.render import Rendering, render_views
        from clsplat.show.camera_paths import orbit

        data, out = dataset_of("render", self.data), place_of(self.out, self.scene, "render")
        try_folder(out)
        gaussians, mode, offset = load_gaussians(scene_file(self.scene))
        device = open_device(self.device)
        scene = load_scene(data, self.data_config)
        gaussians = moved(gaussians, offset - scene.offset)
        views = scene.test or scene.train
        if self.path == "test":
            cameras = {view.name: view.camera for view in views}
        else:
            first = scene.train[0].camera
            path = orbit([view.camera for view in scene.train], self.frames, first.width, first.height)
            cameras = {f"{i:04d}": camera for i, camera in enumerate(path)}
        new_folder(out)
        config = replace(self.render, mode=mode)
        background = BACKGROUNDS[self.data_config.background]

        def write(name: str, rendering: Rendering) -> None:
            target = (out / name).with_suffix(".png")
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
        # PNG compression takes as long as rendering, so that other threads do it at the same time.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            writing: deque[Future[None]] = deque()
            for name, rendering in tqdm(zip(cameras, renderings, strict=True), unit="view", total=len(cameras)):
                writing.append(pool.submit(write, name, rendering))
                if len(writing) > 2 * (os.cpu_count() or 1):
                    writing.popleft().result()
            for image in writing:
                image.result()
        say(f"{out}: {len(cameras)} images")
