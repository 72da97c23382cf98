"""The commands `eval` and `render`."""

import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from clsplat.commands.console import Out, moved, new_folder, open_device, say, say_scores, try_folder
from clsplat.config import BACKGROUNDS, DataConfig, RenderConfig
from clsplat.errors import InputError
from clsplat.ranges import within


@dataclass(frozen=True)
class Eval:
    """Compare renders of a scene with the held-out photos: metrics as JSON, and a web page."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    data: tyro.conf.Positional[Path]
    """Dataset, as for `train`."""
    out: Out
    """Folder for metrics.json, index.html and the renders."""
    device: str | None = None
    """Part of the name of the platform or device."""
    data_config: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    render: Annotated[RenderConfig, tyro.conf.arg(name="")] = field(default_factory=RenderConfig)

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset import load_scene
        from clsplat.evaluate import evaluate
        from clsplat.formats import load_gaussians
        from clsplat.renderer import Renderer

        try_folder(self.out)
        gaussians, mode, offset = load_gaussians(self.scene)
        device = open_device(self.device)
        scene = load_scene(self.data, self.data_config)
        if not scene.test:
            raise InputError(f"{self.data}: expected held-out photos to compare with, found none; see --test-every")
        gaussians = moved(gaussians, offset - scene.offset)
        new_folder(self.out)
        background = BACKGROUNDS[self.data_config.background]
        renderer = Renderer(device, replace(self.render, mode=mode), background)
        say_scores(evaluate(gaussians, scene.test, self.out, renderer), self.out)


@dataclass(frozen=True)
class Render:
    """Render a scene to PNG files: the held-out views of its dataset, or an orbit around the photographed subject."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    data: tyro.conf.Positional[Path]
    """Dataset, as for `train`; its cameras are the views, or determine the orbit."""
    out: Out
    """Folder for the images."""
    path: Literal["test", "orbit"] = "test"
    """test: the held-out views (all views if none is held out). orbit: a closed path around the scene."""
    frames: Annotated[int, within(least=1)] = 60
    """Number of images of an orbit."""
    depth: bool = False
    """Also write the expected depth, as 16-bit PNG scaled to the largest depth."""
    device: str | None = None
    """Part of the name of the platform or device."""
    data_config: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    render: Annotated[RenderConfig, tyro.conf.arg(name="")] = field(default_factory=RenderConfig)

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

        try_folder(self.out)
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
        # PNG compression takes as long as rendering, so that other threads do it at the same time.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            writing: deque[Future[None]] = deque()
            for name, rendering in tqdm(zip(cameras, renderings, strict=True), unit="view", total=len(cameras)):
                writing.append(pool.submit(write, name, rendering))
                if len(writing) > 2 * (os.cpu_count() or 1):
                    writing.popleft().result()
            for image in writing:
                image.result()
        say(f"{self.out}: {len(cameras)} images")
