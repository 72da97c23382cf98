"""Figures of a trained scene: quality on held-out and on training photos, sizes of files, rate of frames."""

import math
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.bench.results import Record
from clsplat.evaluate import compared, mean_metrics, mean_of, rendered
from clsplat.formats import save_gaussians
from clsplat.gaussians import Gaussians
from clsplat.metrics import flip, psnr, ssim
from clsplat.render import Stored, renderings
from clsplat.renderer import Renderer
from clsplat.scene import Scene, View, digest, evenly_spaced

FRAMES = 5
"""Number of times that each held-out view is rendered for the rate of frames."""

TRAINING_PHOTOS = 24
"""Largest number of training photos that are measured. The standard error of their mean PSNR is then about a fifth of
the spread over photos, while the measurement takes no longer than that of the held-out photos of a large scene."""

SAMPLES = 8
"""Number of samples of a training. Their iterations form a geometric sequence."""

FIRST_SAMPLE = 1 / 50
"""Position of the first sample, as a fraction of the iterations. Earlier renders show little."""

Masks = list[NDArray[np.bool_]]


def sample_iterations(iterations: int) -> list[int]:
    """Iterations after which samples are taken: a geometric sequence that includes the last iteration."""
    return sorted({int(i) for i in np.rint(np.geomspace(max(1, FIRST_SAMPLE * iterations), iterations, SAMPLES))})


def facts_of(scene: Scene, rare: Masks | None) -> Record:
    """Digest and numbers of the photos, their largest size, and the fraction of held-out pixels that are rare."""
    views = scene.train + scene.test
    return {
        "photos": digest_of(scene),
        "train": len(scene.train),
        "test": len(scene.test),
        "width": max(view.camera.width for view in views),
        "height": max(view.camera.height for view in views),
        "rare": rare_share(scene.test, rare),
    }


def digest_of(scene: Scene) -> str:
    """Digest of the photos: their names and pixels, or the names alone if the photos stream from the disk.

    It tells datasets apart whose folders have the same name.
    """
    parts = [[(v.name, None if v.ahead else v.digests) for v in part] for part in (scene.train, scene.test)]
    return digest(np.frombuffer(repr(parts).encode(), np.uint8))


def measure(
    gaussians: Gaussians, views: list[View], renderer: Renderer, folder: Path, rare: Masks | None = None
) -> Record:
    """Quality on held-out views, number of Gaussians, and sizes of files, which are written to `folder`.

    Parameters
    ----------
    gaussians : Gaussians
    views : list of View
    renderer : Renderer
    folder : Path
    rare : list of (H, W) bool, optional
        Pixels of each view for `rare_psnr`, as from `clsplat.dataset.coverage.rare_pixels`.
    """
    figures = quality_of(rendered(gaussians, views, renderer), views, rare)
    sizes = {}
    for suffix in ("ply", "spz"):
        path = folder / f"sample.{suffix}"
        save_gaussians(path, gaussians, renderer.config.mode)
        sizes[f"{suffix}_bytes"] = path.stat().st_size
    return {"num_gaussians": len(gaussians), "sh_degree": gaussians.sh_degree, **sizes, **figures}


def quality_of(images: Iterable[NDArray[np.uint8]], views: list[View], rare: Masks | None = None) -> Record:
    """Quality of images, one per held-out view; `views` and `rare` as for `measure`."""
    masks: Sequence[NDArray[np.bool_] | None] = rare or [None] * len(views)

    def compare(index: int, view: View, image: NDArray[np.uint8]) -> list[float | None]:
        figures = [metric(image, view.image, view.mask) for metric in (psnr, ssim, flip)]
        return [*figures, *_squared_error(image, view, masks[index])]

    psnrs, ssims, flips, errors, numbers = zip(*compared(compare, views, images), strict=True)
    figures = {"psnr": mean_of(psnrs), "ssim": mean_of(ssims), "flip": mean_of(flips), "worst": min(psnrs)}
    error, number = sum(errors), sum(numbers)
    figures["rare_psnr"] = -10 * math.log10(error / number) if error else None
    return finite(figures)


def finite(figures: dict[str, float | None]) -> Record:
    """The figures, with None in place of infinity, which JSON does not have."""
    return {name: value if value is not None and math.isfinite(value) else None for name, value in figures.items()}


def _counted(view: View, rare: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return rare if view.mask is None else rare & view.mask


def _squared_error(image: NDArray[np.uint8], view: View, rare: NDArray[np.bool_] | None) -> tuple[float, int]:
    """Sum of the squared errors over some pixels of a view, for values in [0, 1], and the number of the values."""
    if rare is None:
        return 0.0, 0
    differences = (image.astype(float) - view.image)[_counted(view, rare)] / 255
    return float((differences**2).sum()), differences.size


def rare_share(views: list[View], rare: Masks | None) -> float | None:
    """Fraction of the pixels of held-out views that are rare; None if unknown."""
    if rare is None:
        return None
    pixels = sum(
        mask.size if view.mask is None else int(view.mask.sum()) for view, mask in zip(views, rare, strict=True)
    )
    return sum(int(_counted(view, mask).sum()) for view, mask in zip(views, rare, strict=True)) / pixels


def training_psnr(gaussians: Gaussians | Stored, views: list[View], renderer: Renderer) -> Record:
    """Mean PSNR of at most `TRAINING_PHOTOS` training photos, evenly spaced, as the entry `train_psnr`."""
    figures = mean_metrics(gaussians, evenly_spaced(views, TRAINING_PHOTOS), renderer, metrics=(psnr,))
    return finite({"train_psnr": figures["psnr"]})


def frames_per_second(gaussians: Gaussians, views: list[View], renderer: Renderer) -> float:
    """Reciprocal of the median time from a camera to its image in the host's memory, 1/s."""
    cameras = [view.camera for view in views]
    # One round more than is timed: the first one includes work that the device does only once.
    images = renderings(renderer, gaussians, cameras * (FRAMES + 1))
    seconds = []
    while True:
        started = time.perf_counter()
        if next(images, None) is None:
            break
        seconds.append(time.perf_counter() - started)
    return 1 / float(np.median(seconds[len(cameras) :]))
