"""Measure the cost of each format of `FORMATS`: bytes per Gaussian, seconds, and PSNR lost on the held-out photos.

Run ``make formats SCENE=scene.ply DATA=dataset``. The dataset, and further options in OPTIONS, are as for
``clsplat train``.
"""

import tempfile
import time
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tyro

from clsplat.config import BACKGROUNDS, DataConfig, RenderConfig
from clsplat.dataset import load_scene
from clsplat.evaluate import mean_metrics
from clsplat.formats import FORMATS, load_gaussians, save_gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.renderer import Renderer, download


@dataclass(frozen=True)
class Arguments:
    """Write a scene in every format, read it back, and compare renders of the held-out views."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    dataset: tyro.conf.Positional[Path]
    """Dataset, as for `train`."""
    data: tyro.conf.OmitArgPrefixes[DataConfig] = field(default_factory=DataConfig)


def main() -> None:
    arguments = tyro.cli(Arguments, description=Arguments.__doc__)
    gaussians, mode, _ = load_gaussians(arguments.scene)
    scene = load_scene(arguments.dataset, arguments.data)
    renderer = Renderer(None, RenderConfig(mode=mode), BACKGROUNDS[arguments.data.background])

    def renders(candidate):
        images = (renderer.forward(candidate, v.camera, gradients=False).image.rgb for v in scene.test)
        return [to_uint8(download(image)).astype(np.float32) / 255 for image in images]

    def score(candidate):
        return mean_metrics(candidate, scene.test, renderer)["psnr"]

    before, reference, degree = renders(gaussians), score(gaussians), gaussians.sh_degree
    print(f"{arguments.scene}: {len(gaussians)} Gaussians, SH degree {degree}, PSNR {reference:.2f} dB\n")
    degrees = " | ".join(f"degree {d}" for d in range(degree + 1))
    print(f"| format | {degrees} | smaller than PLY | write s | read s | PSNR lost dB | PSNR to before dB |")
    print("|---" * (degree + 7) + "|")
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        plain = 0
        for suffix in FORMATS:
            path = Path(folder) / f"scene{suffix}"
            sizes = []
            for cut in range(degree + 1):
                less = replace(gaussians, sh=gaussians.sh[:, : (cut + 1) ** 2])
                started = time.perf_counter()
                save_gaussians(path, less, mode)
                written = time.perf_counter()
                sizes.append(path.stat().st_size)
            again = load_gaussians(path)[0]
            read = time.perf_counter()
            plain = plain or sizes[-1]
            same = np.mean([psnr(a, b) for a, b in zip(before, renders(again), strict=True)])
            cells = [f"`{suffix}`", *(f"{size / len(gaussians):.1f}" for size in sizes), f"{plain / sizes[-1]:.1f}"]
            cells += [f"{written - started:.2f}", f"{read - written:.2f}"]
            cells += [f"{reference - score(again):.3f}", f"{same:.1f}"]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
