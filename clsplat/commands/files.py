"""The commands `devices`, `frames`, `sfm` and `export`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from clsplat.commands import console
from clsplat.commands.console import OptionalOut, Out, SceneOrRun, moved, picture_cameras, say, say_cameras
from clsplat.commands.options import PageOptions
from clsplat.commands.run_folders import scene_file, with_run
from clsplat.config import Mode, SfmConfig
from clsplat.errors import InputError
from clsplat.ranges import within

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians


@dataclass(frozen=True)
class Devices:
    """List the OpenCL devices, their capabilities, and the default device."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.device import device_label, list_devices, select_device

        default = select_device()
        for device in list_devices():
            extensions = device.extensions
            capabilities = [
                f"{device.max_compute_units} compute units",
                f"{device.global_mem_size / 2**30:.1f} GiB, {device.max_mem_alloc_size / 2**30:.1f} GiB per buffer",
                f"{device.local_mem_size // 1024} KiB local",
                device.version.strip(),
                "double precision" if "cl_khr_fp64" in extensions else "no double precision",
                "subgroups" if "subgroups" in extensions else "no subgroups",
            ]
            print(f"{'*' if device == default else ' '} {device_label(device)}\n    {'; '.join(capabilities)}")
        print("* is the default; choose another device with --device and part of its name, or with PYOPENCL_CTX")


@dataclass(frozen=True)
class Frames:
    """Extract photos from a video: the sharpest frame of each interval."""

    video: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="VIDEO")]
    """The video; needs the extra `video`."""
    out: Out
    """New folder for the photos."""
    fps: Annotated[float, within(above=0)] = 2.0
    """Photos per second of the video."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset.video import extract_frames

        count = extract_frames(self.video, self.out, self.fps)
        say(f"{self.out}: {count} frames of {self.video.name}; next: clsplat train {self.out} -o SCENE")


@dataclass(frozen=True)
class Sfm:
    """Recover the cameras of a folder of photos; `train` does this itself."""

    photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photos."""
    out: OptionalOut = None
    """Folder for the model; default: the folder of the photos."""
    sfm: Annotated[SfmConfig, tyro.conf.arg(name="")] = field(default_factory=SfmConfig)

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset.sfm.reconstruction import reconstruct

        model = reconstruct(self.photos, self.sfm, self.out, verbose=console.loudness == "verbose")
        say_cameras(self.out or self.photos)
        picture_cameras(self.out or self.photos, model.parent / "cameras.png")
        print(model)


@dataclass(frozen=True)
class Export:
    """Convert a scene to another format, or to a web page that shows it in any browser."""

    scene: SceneOrRun
    """File of Gaussians, or the folder of a run."""
    to: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[FILE]")] = None
    """File to write; its suffix determines the format; .html makes a web page."""
    out: OptionalOut = None
    """Alternative to the second argument."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DATASET")] = None
    """For a web page: dataset, as for `train`. Its first photo is the first view, and its cameras determine the
    upward direction. Default: the dataset of the run."""
    data_config: Annotated[PageOptions, tyro.conf.arg(name="")] = field(default_factory=PageOptions)

    def base(self) -> "Export | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self)

    def run(self) -> None:
        """Run the command."""
        from clsplat.formats import load_gaussians, save_gaussians

        if (self.to is None) == (self.out is None):
            raise InputError("export: expected one file to write, as in: clsplat export scene.ply scene.spz")
        out = self.to or self.out
        assert out is not None
        gaussians, mode, offset = load_gaussians(scene_file(self.scene))
        if out.suffix.lower() == ".html":
            self._page(out, gaussians, mode, offset)
        else:
            save_gaussians(out, gaussians, mode, offset)
        say(f"{out}: {len(gaussians)} Gaussians, {out.stat().st_size / 1e6:.3g} MB")

    def _page(self, out: Path, gaussians: "Gaussians", mode: Mode, offset: Any) -> None:
        from clsplat.dataset import load_scene
        from clsplat.show.camera_paths import first_photo, overview
        from clsplat.show.web_page import save_page

        views = []
        if self.data is not None:
            scene = load_scene(self.data, self.data_config)
            gaussians, views = moved(gaussians, offset - scene.offset), scene.train + scene.test
        start = first_photo([view.camera for view in views]) if views else overview(gaussians)
        save_page(out, gaussians, mode, start, self.data_config.background)
