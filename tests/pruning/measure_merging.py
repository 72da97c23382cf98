"""Quality at fractions of the Gaussians, by removal alone and by removal and merging: docs/howto/compact.md.

``python tests/pruning/measure_merging.py scene.ply --photos dataset --downscale 4``
"""

import time

import numpy as np
import tyro
from opened_scene import Arguments, opened

from clsplat.evaluate import mean_metrics
from clsplat.gaussians import Gaussians
from clsplat.pruning.prices import removal_order
from clsplat.pruning.reductions import reduce

FRACTIONS = (0.8, 0.5, 0.3, 0.2, 0.1, 0.05)


def main() -> None:
    arguments = tyro.cli(Arguments, description="Reduce a scene to fractions of its Gaussians in two ways.")
    gaussians, pricing, evaluation, renderer = opened(arguments)
    n = len(gaussians)

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
