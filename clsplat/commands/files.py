"""The commands `devices`, `sfm` and `export`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from clsplat.commands.console import Out, say
from clsplat.config import SfmConfig


@dataclass(frozen=True)
class Devices:
    """List the OpenCL devices, what each can do, and the one that would be taken."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.device import device_label, list_devices, select_device

        default = select_device()
        for device in list_devices():
            extensions = device.extensions
            abilities = [
                f"{device.max_compute_units} compute units",
                f"{device.global_mem_size / 2**30:.1f} GiB, {device.max_mem_alloc_size / 2**30:.1f} GiB per buffer",
                f"{device.local_mem_size // 1024} KiB local",
                device.version.strip(),
                "double precision" if "cl_khr_fp64" in extensions else "no double precision",
                "subgroups" if "subgroups" in extensions else "no subgroups",
            ]
            print(f"{'*' if device == default else ' '} {device_label(device)}\n    {'; '.join(abilities)}")
        print("* is taken by default; choose another by part of its name: --device NAME, or by PYOPENCL_CTX")


@dataclass(frozen=True)
class Sfm:
    """Recover the cameras of a folder of photos (pycolmap); `train` does so by itself where it is needed."""

    photos: tyro.conf.Positional[Path]
    """Folder of photos."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder for the model; default: beside the photos."""
    sfm: Annotated[SfmConfig, tyro.conf.arg(name="")] = field(default_factory=SfmConfig)

    def run(self) -> None:
        """Run the command."""
        from clsplat.sfm import reconstruct

        print(reconstruct(self.photos, self.sfm, self.out))


@dataclass(frozen=True)
class Export:
    """Convert a file of Gaussians; formats are told by the suffix."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    out: Out
    """File to write."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.io import load_gaussians, save_gaussians

        gaussians, mode, offset = load_gaussians(self.scene)
        save_gaussians(self.out, gaussians, mode, offset)
        say(f"{self.out}: {len(gaussians)} Gaussians")
