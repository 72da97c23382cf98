"""The command `view`."""

import webbrowser
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from clsplat.commands.console import DeviceName, SceneOrRun, moved, open_device, say, warn
from clsplat.commands.options import ServerOptions, ViewerDrawOptions, ViewOptions
from clsplat.commands.run_folders import scene_file, with_run
from clsplat.config import BACKGROUNDS

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.show.viewer import Viewer


@dataclass(frozen=True)
class View:
    """Show a scene in the browser; needs the extra `viewer`."""

    scene: SceneOrRun
    """File of Gaussians, or the folder of a run."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DATASET")] = None
    """Dataset, as for `train`: its cameras are shown, and a click on one moves the view there. Default: the dataset
    of the run."""
    server: Annotated[ServerOptions, tyro.conf.arg(name="")] = field(default_factory=ServerOptions)
    device: DeviceName = None
    """Part of the name of the platform or device."""
    data_config: Annotated[ViewOptions, tyro.conf.arg(name="")] = field(default_factory=ViewOptions)
    render: Annotated[ViewerDrawOptions, tyro.conf.arg(name="")] = field(default_factory=ViewerDrawOptions)

    def base(self) -> "View | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self)

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset import load_scene
        from clsplat.formats import load_gaussians, save_gaussians
        from clsplat.renderer import Renderer
        from clsplat.show.camera_paths import first_photo, overview

        path = scene_file(self.scene)
        viewer = open_viewer(self.server)
        try:
            viewer.wait(f"reading {path.name}")
            gaussians, mode, offset = load_gaussians(path)
            device = open_device(self.device)
            views = []
            if self.data is not None:
                viewer.wait("reading the photos")
                scene = load_scene(self.data, self.data_config)
                gaussians, offset = moved(gaussians, offset - scene.offset), scene.offset
                views = scene.train + scene.test
            start = first_photo([view.camera for view in views]) if views else overview(gaussians)
            renderer = Renderer(device, replace(self.render, mode=mode), BACKGROUNDS[self.data_config.background])
            edited = edited_file(path)

            def save(rest: "Gaussians") -> str:
                save_gaussians(edited, rest, mode, offset)
                return f"{edited}: {len(rest):,} Gaussians"

            viewer.wait("compiling kernels")
            viewer.show(renderer, start, views)
            viewer.edit(gaussians, save)
            viewer.tell({"File": path.name, "Gaussians": f"{len(gaussians):,}", "Device": device.label})
            with suppress(KeyboardInterrupt):
                viewer.hold(gaussians)
        finally:
            viewer.close()


def edited_file(scene: Path) -> Path:
    """The file for a session's edit of a scene, which replaces no file: from the second on, its name has a number."""
    stem = f"{scene.name.removesuffix('.ply').removesuffix('.compressed')}_edited"
    edited, number = scene.with_name(f"{stem}.ply"), 2
    while edited.exists():
        edited, number = scene.with_name(f"{stem}-{number}.ply"), number + 1
    return edited


def open_viewer(options: ServerOptions) -> "Viewer":
    """Start the viewer's server, report its address, and open a browser if the options say so."""
    from clsplat.show.viewer import Viewer

    viewer = Viewer(host=options.host, port=options.port)
    say(f"viewer: open {viewer.address} in a browser")
    if options.open and not webbrowser.open(viewer.address):
        warn(f"--open: no browser was found; open {viewer.address} yourself")
    return viewer
