"""The command `demo`: the whole path from photos to an evaluated scene, on photos that it makes."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from clsplat.commands.console import DeviceName, Out, say, write_json
from clsplat.commands.run_folders import CONFIG
from clsplat.commands.train import open_and_name, train_and_report
from clsplat.config import UINT32_MAX, TrainConfig
from clsplat.errors import InputError, new_folder
from clsplat.ranges import within
from clsplat.training.presets import DATA_PATH


@dataclass(frozen=True)
class Demo:
    """Make photos of a still life, recover their cameras, train, evaluate: the whole path in minutes."""

    out: Out = Path("clsplat-demo")
    """Folder for everything that is made."""
    iterations: Annotated[int, within(least=1, most=UINT32_MAX)] = 1500
    """Optimisation steps."""
    device: DeviceName = None
    """Part of the platform's or device's name."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.demo import make_photos
        from clsplat.render import render_views
        from clsplat.show.comparisons import side_by_side
        from clsplat.training.preparation import prepare

        if self.out.exists() and any(self.out.iterdir()):
            raise InputError(f"{self.out}: expected an empty or new folder for the demo; choose another with -o")
        started = time.perf_counter()
        config = TrainConfig(iterations=self.iterations, eval_every=max(1, self.iterations // 7), device=self.device)
        device = open_and_name(config)
        photos = self.out / "photos"
        new_folder(photos)
        say("photos: ray tracing a still life")
        make_photos(photos)
        say("cameras: structure from motion on the photos alone")
        scene, config = prepare(photos, config, device, tell=say)
        write_json(self.out / CONFIG, {DATA_PATH: photos.name, **asdict(config)})
        gaussians = train_and_report(scene, config, device, self.out, resume=False)
        renderings = render_views(gaussians, [view.camera for view in scene.test], config.render, device)
        pairs = [(view.image, rendering.rgb) for view, rendering in zip(scene.test, renderings, strict=True)]
        side_by_side(self.out / "side_by_side.png", pairs)
        say(
            f"done in {time.perf_counter() - started:.0f} s. Look at {self.out / 'side_by_side.png'} (photo and "
            f"render), {self.out / 'training_curve.png'} and {self.out / 'eval' / 'index.html'}; "
            f"{self.out / 'scene.ply'} has the format that splat viewers read."
        )
