"""Quality at fractions of the Gaussians, by removal alone and by removal and merging: docs/howto/compact.md.

``python tests/pruning/measure_merging.py scene.ply --photos dataset --downscale 4``
"""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from clsplat.commands.compact import Compact
from clsplat.config import BACKGROUNDS, DataConfig, RenderConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.evaluate import mean_metrics
from clsplat.formats import load_gaussians
from clsplat.gaussians import Gaussians
from clsplat.pruning.prices import removal_order
from clsplat.pruning.reductions import reduce
from clsplat.renderer import Renderer

FRACTIONS = (0.8, 0.5, 0.3, 0.2, 0.1, 0.05)


@dataclass(frozen=True)
class Arguments:
    """Reduce a scene to fractions of its Gaussians in two ways."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    photos: Path | None = None
    """Dataset, as given to `train`; without it automatic viewpoints."""
    data: tyro.conf.OmitArgPrefixes[DataConfig] = field(default_factory=DataConfig)


def main() -> None:
    arguments = tyro.cli(Arguments, description=Arguments.__doc__)
    gaussians, mode, _ = load_gaussians(arguments.scene)
    n = len(gaussians)
    renderer = Renderer(Device(), RenderConfig(mode=mode), BACKGROUNDS[arguments.data.background])
    scene = None if arguments.photos is None else load_scene(arguments.photos, arguments.data)
    command = Compact(arguments.scene, Path("-"), photos=arguments.photos, data_config=arguments.data)
    pricing, evaluation = command._views(gaussians, scene, renderer)

    def enough(left: Gaussians) -> bool:
        return len(left) <= FRACTIONS[-1] * n

    started = time.perf_counter()
    order = removal_order(gaussians, pricing, enough, renderer)
    removal = time.perf_counter() - started
    reduction = reduce(gaussians, pricing, enough, renderer)
    print(f"removal {removal:.0f} s, removal and merging {time.perf_counter() - started - removal:.0f} s", flush=True)
    for fraction in FRACTIONS:
        left = int(fraction * n)
        rows = reduction.rows(left)
        cells = [f"{100 * fraction:.0f} %", f"{100 * (rows >= n).mean():.0f} %"]
        for version in (gaussians.take(np.sort(order[:left])), reduction.pool.take(rows)):
            found = mean_metrics(version, evaluation, renderer)
            cells += [f"{found['psnr']:.2f}", f"{found['ssim']:.4f}"]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
