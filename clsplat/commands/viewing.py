"""The command `view`."""

from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from clsplat.commands.console import DeviceName, SceneOrRun, moved, open_device, say
from clsplat.commands.options import DrawOptions, ViewOptions
from clsplat.commands.run_folders import scene_file, with_run
from clsplat.config import BACKGROUNDS
from clsplat.ranges import within


@dataclass(frozen=True)
class View:
    """Show a scene in the browser; needs the extra `viewer`."""

    scene: SceneOrRun
    """File of Gaussians, or the folder of a run."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DATASET")] = None
    """Dataset, as for `train`: its cameras are shown, and a click on one moves the view there. Default: the dataset
    of the run."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 admits other machines, with the token in the printed address."""
    port: Annotated[int, within(least=0, most=65535)] = 8080
    """Port to listen on; if it is in use, the next free one."""
    device: DeviceName = None
    """Part of the name of the platform or device."""
    data_config: Annotated[ViewOptions, tyro.conf.arg(name="")] = field(default_factory=ViewOptions)
    render: Annotated[DrawOptions, tyro.conf.arg(name="")] = field(default_factory=DrawOptions)

    def base(self) -> "View | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self)

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset import load_scene
        from clsplat.formats import load_gaussians
        from clsplat.renderer import Renderer
        from clsplat.show.camera_paths import first_photo, overview
        from clsplat.show.viewer import Viewer

        gaussians, mode, offset = load_gaussians(scene_file(self.scene))
        device = open_device(self.device)
        views = []
        if self.data is not None:
            scene = load_scene(self.data, self.data_config)
            gaussians = moved(gaussians, offset - scene.offset)
            views = scene.train + scene.test
        start = first_photo([view.camera for view in views]) if views else overview(gaussians)
        background = BACKGROUNDS[self.data_config.background]
        renderer = Renderer(device, replace(self.render, mode=mode), background)
        viewer = Viewer(renderer, start, views, host=self.host, port=self.port)
        viewer.tell({"File": self.scene.name, "Gaussians": f"{len(gaussians):,}", "Device": device.label})
        say(f"viewer: open {viewer.address} in a browser; Ctrl-C closes the viewer")
        with suppress(KeyboardInterrupt):
            viewer.hold(gaussians)
        viewer.close()
