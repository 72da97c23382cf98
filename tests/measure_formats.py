"""What each format of `FORMATS` costs: bytes per Gaussian, seconds, and PSNR lost on the held-out photos.

``make formats SCENE=scene.ply DATA=dataset``, the dataset and --downscale as given to ``clsplat train``.
"""

import tempfile
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from clsplat.config import BACKGROUNDS, DataConfig, RenderConfig
from clsplat.device import Device
from clsplat.evaluate import mean_metrics
from clsplat.io import FORMATS, load_gaussians, load_scene, save_gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.render import render


@dataclass(frozen=True)
class Arguments:
    """Write a scene in every format, read it back, and compare renders of the held-out views."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    dataset: tyro.conf.Positional[Path]
    """Dataset, as given to `train`."""
    data: tyro.conf.OmitArgPrefixes[DataConfig] = field(default_factory=DataConfig)


def main() -> None:
    arguments = tyro.cli(Arguments, description=Arguments.__doc__)
    gaussians, mode, _ = load_gaussians(arguments.scene)
    scene = load_scene(arguments.dataset, arguments.data)
    device, config = Device(), RenderConfig(mode=mode)
    background = BACKGROUNDS[arguments.data.background]

    def renders(candidate):
        return [to_uint8(render(candidate, v.camera, config, device, background=background).rgb) for v in scene.test]

    before = renders(gaussians)
    reference = mean_metrics(gaussians, scene.test, config, device, background)["psnr"]
    print(f"{arguments.scene}: {len(gaussians)} Gaussians, SH degree {gaussians.sh_degree}, PSNR {reference:.2f} dB")
    print("| format | bytes per Gaussian | smaller than PLY | write s | read s | PSNR lost dB | PSNR to before dB |")
    print("|---|---|---|---|---|---|---|")
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        sizes = {}
        for suffix in FORMATS:
            path = Path(folder) / f"scene{suffix}"
            times = [time.perf_counter()]
            save_gaussians(path, gaussians, mode)
            times.append(time.perf_counter())
            again = load_gaussians(path)[0]
            times.append(time.perf_counter())
            sizes[suffix] = path.stat().st_size
            after = mean_metrics(again, scene.test, config, device, background)["psnr"]
            pairs = zip(before, renders(again), strict=True)
            same = np.mean([psnr(a.astype(np.float32) / 255, b.astype(np.float32) / 255) for a, b in pairs])
            write, read = np.diff(times)
            smaller = sizes[".ply"] / sizes[suffix]
            print(
                f"| `{suffix}` | {sizes[suffix] / len(gaussians):.1f} | {smaller:.1f} | {write:.2f} | {read:.2f} "
                f"| {reference - after:.3f} | {same:.1f} |"
            )


if __name__ == "__main__":
    main()
