"""Smallest files within a loss of SSIM, by ways to reduce Gaussians and harmonics: docs/howto/compact.md.

``python tests/pruning/measure_bytes.py scene.ply --photos dataset --downscale 4``
"""

import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from opened_scene import Arguments, opened

from clsplat.evaluate import mean_metrics
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.pruning.compaction import choices_of
from clsplat.pruning.prices import removal_order
from clsplat.pruning.reductions import reduce

SMALLEST = 0.4
"""Fraction of the Gaussians at which the rounds end."""

STEP = 1.05
"""Factor to which the number of Gaussians is found."""


@dataclass(frozen=True)
class BytesArguments(Arguments):
    """Find the smallest files within a loss of SSIM on the evaluation views."""

    formats: tuple[str, ...] = (".sog", ".spz")
    loss: float = 0.001
    """Largest loss of SSIM, rounding by the format included."""


def main() -> None:
    arguments = tyro.cli(BytesArguments, description=BytesArguments.__doc__)
    warnings.simplefilter("ignore")
    gaussians, pricing, evaluation, renderer = opened(arguments)
    n = len(gaussians)

    def enough(left: Gaussians) -> bool:
        return len(left) < SMALLEST * n

    def quality(version: Gaussians) -> tuple[float, float]:
        found = mean_metrics(version, evaluation, renderer)
        return found["ssim"], found["psnr"]

    best = quality(gaussians)
    least = best[0] - arguments.loss
    print(f"{arguments.scene}: {n} Gaussians, SSIM {best[0]:.4f}, PSNR {best[1]:.2f} dB", flush=True)
    started = time.perf_counter()
    order = removal_order(gaussians, pricing, enough, renderer)
    seconds = [time.perf_counter() - started]
    reduction = reduce(gaussians, pricing, enough, renderer)
    seconds.append(time.perf_counter() - started - seconds[0])
    choices = choices_of(gaussians, reduction, pricing, gaussians.sh_degree, True, renderer)
    seconds.append(time.perf_counter() - started - sum(seconds))
    print("removal {:.0f} s, removal and merging {:.0f} s, harmonics {:.0f} s".format(*seconds), flush=True)
    cut = [replace(gaussians, sh=gaussians.sh[:, : (d + 1) ** 2]) for d in range(gaussians.sh_degree + 1)]
    ways: dict[str, tuple[list[Gaussians], Callable[[int], np.ndarray]]] = {
        "removal, cut bands": (cut[-2:], lambda left: np.sort(order[:left])),
        "removal and merging, shared harmonics": (choices, reduction.rows),
    }
    for suffix in arguments.formats:
        for name, (versions, rows) in ways.items():
            found = [
                smallest(version, rows, n, partial(stored, suffix=suffix, mode=renderer.config.mode), quality, least)
                for version in versions
            ]
            reached = [row for row in found if row[0]] or [max(found, key=lambda row: row[3])]
            within, size, left, ssim, psnr = min(reached, key=lambda row: row[1])
            note = "" if within else "not reached: "
            print(
                f"| `{suffix}` | {name} | {left} | {size / 1e3:.0f} kB | {note}{ssim - best[0]:+.4f} | "
                f"{psnr - best[1]:+.3f} dB |",
                flush=True,
            )


def stored(gaussians: Gaussians, suffix: str, mode: str) -> tuple[Gaussians, int]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene{suffix}"
        save_gaussians(path, gaussians, mode)
        return load_gaussians(path)[0], path.stat().st_size


def smallest(pool, rows, n, store, quality, least) -> tuple[bool, int, int, float, float]:
    """Whether the SSIM is reached, bytes, Gaussians, SSIM and PSNR of the smallest version that reaches it, or
    of all Gaussians."""

    def tried(left: int) -> tuple[bool, int, int, float, float]:
        again, size = store(pool.take(rows(left)))
        ssim, psnr = quality(again)
        return ssim >= least, size, left, ssim, psnr

    good = tried(n)
    low = SMALLEST * n
    while good[0] and good[2] / low > STEP:
        middle = int(np.sqrt(low * good[2]))
        found = tried(middle)
        good, low = (found, low) if found[0] else (good, middle)
    return good


if __name__ == "__main__":
    main()
