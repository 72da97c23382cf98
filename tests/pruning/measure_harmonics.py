"""PSNR lost by lower degrees and shared bands, without any format: docs/howto/compact.md.

``python tests/pruning/measure_harmonics.py scene.ply --photos dataset --downscale 4``
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from clsplat.commands.compact import Compact
from clsplat.config import BACKGROUNDS, DataConfig, RenderConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.evaluate import mean_metrics
from clsplat.formats import load_gaussians
from clsplat.pruning import harmonics
from clsplat.pruning.compaction import PALETTE_PARTS
from clsplat.pruning.harmonics import curvatures, fitted_degree, with_shared_bands
from clsplat.pruning.prices import with_degree
from clsplat.renderer import Renderer

SPREADS = (0.005, 0.02, 0.2)


@dataclass(frozen=True)
class Arguments:
    """Cut, fit and share the harmonics of a scene."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    photos: Path
    """Dataset, as given to `train`."""
    data: tyro.conf.OmitArgPrefixes[DataConfig] = field(default_factory=DataConfig)


def main() -> None:
    arguments = tyro.cli(Arguments, description=Arguments.__doc__)
    gaussians, mode, _ = load_gaussians(arguments.scene)
    renderer = Renderer(Device(), RenderConfig(mode=mode), BACKGROUNDS[arguments.data.background])
    scene = load_scene(arguments.photos, arguments.data)
    command = Compact(arguments.scene, Path("-"), photos=arguments.photos, data_config=arguments.data)
    pricing, evaluation = command._views(gaussians, scene, renderer)

    def lost(version) -> str:
        found = mean_metrics(version, evaluation, renderer)
        return f"{found['psnr'] - best['psnr']:+.2f} dB, {found['ssim'] - best['ssim']:+.4f}"

    best = mean_metrics(gaussians, evaluation, renderer)
    degrees = range(gaussians.sh_degree)
    print(f"| cut | {' | '.join(lost(with_degree(gaussians, d)) for d in degrees)} |", flush=True)
    for harmonics.SPREAD in SPREADS:
        started = time.perf_counter()
        curvature = curvatures(gaussians, pricing, renderer)
        cells = [lost(fitted_degree(gaussians, curvature, d)) for d in degrees]
        cells += [lost(with_shared_bands(gaussians, curvature, len(gaussians) // part)) for part in PALETTE_PARTS]
        print(f"| {harmonics.SPREAD} | {' | '.join(cells)} | {time.perf_counter() - started:.0f} s", flush=True)


if __name__ == "__main__":
    main()
