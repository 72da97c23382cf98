"""PSNR lost by lower degrees and shared bands, without any format: docs/howto/compact.md.

``python tests/pruning/measure_harmonics.py scene.ply --photos dataset --downscale 4``
"""

import time

import tyro
from opened_scene import Arguments, opened

from clsplat.evaluate import mean_metrics
from clsplat.pruning import harmonics
from clsplat.pruning.compaction import PALETTE_PARTS
from clsplat.pruning.harmonics import curvatures, fitted_degree, with_shared_bands
from clsplat.pruning.prices import with_degree

SPREADS = (0.005, 0.02, 0.2)


def main() -> None:
    arguments = tyro.cli(Arguments, description="Cut, fit and share the harmonics of a scene.")
    gaussians, pricing, evaluation, renderer = opened(arguments)

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
