"""Evaluation: render views, compare them with their photos, and write metrics and a page of pictures."""

import json
import math
import os
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.dataset.finding import without_suffix
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.metrics import flip, psnr, psnr_fitted, ssim, to_uint8
from clsplat.render import Stored, renderings
from clsplat.renderer import Renderer
from clsplat.scene import View, in_turn
from clsplat.show.comparisons import save_difference, save_png
from clsplat.show.evaluation_page import write_page
from clsplat.show.picture_names import distinct_stems

Result = TypeVar("Result")
Metric = Callable[..., float | None]

METRICS: tuple[Metric, ...] = (psnr, psnr_fitted, ssim, flip)
"""The metrics of every evaluation."""

PENDING = os.cpu_count() or 1
"""Most comparisons that wait for a thread."""


def mean_metrics(
    gaussians: Gaussians | Stored,
    views: Iterable[View],
    renderer: Renderer | None = None,
    metrics: Iterable[Metric] = (psnr, ssim),
) -> dict[str, Any]:
    """Mean metrics over views, for the log of a training run.

    Parameters
    ----------
    gaussians, views, renderer
        As given to `evaluate`.
    metrics : iterable of functions of `clsplat.metrics`

    Returns
    -------
    dict
        By the metrics' names: psnr in decibels, ssim, flip. None where a metric is not installed.
    """
    views = list(views)
    return mean_metrics_of(rendered(gaussians, views, renderer or Renderer()), views, metrics)


def mean_metrics_of(
    images: Iterable[NDArray[np.uint8]], views: list[View], metrics: Iterable[Metric] = (psnr, ssim)
) -> dict[str, Any]:
    """Mean metrics of images, one per view. Metrics and result as for `mean_metrics`."""
    metrics = list(metrics)

    def compare(_: int, view: View, image: NDArray[np.uint8]) -> list[float | None]:
        return [metric(image, view.image, view.mask) for metric in metrics]

    figures = zip(*compared(compare, views, images), strict=True)
    return {m.__name__: mean_of(values) for m, values in zip(metrics, figures, strict=True)}


def evaluate(
    gaussians: Gaussians | Stored,
    views: Iterable[View],
    out: Path | str,
    renderer: Renderer | None = None,
    metrics: Sequence[Metric] = METRICS,
) -> dict[str, Any]:
    """Render views and compare them with their photos.

    Parameters
    ----------
    gaussians : Gaussians or Stored
        In the coordinates of the views, on the host or on the renderer's device.
    views : iterable of View
        At least one; usually a scene's held-out views.
    out : Path or str
        Folder for metrics.json, index.html, and the pictures in truth/, render/ and difference/; created if missing.
    renderer : Renderer, optional
        Its background is that of the photos where they were transparent. Default: ``Renderer()``.
    metrics : functions of `clsplat.metrics`
        Metrics to compute, such as `METRICS`, or `METRICS` and `lpips`.

    Returns
    -------
    dict
        The content of metrics.json. ``mean`` holds the means over the views of psnr (dB), psnr_fitted (dB, after an
        affine fit of the colours), ssim, flip, and lpips if it is in `metrics`; ``views`` holds the same of each
        view, its size and the paths of its pictures. None (null) stands for an infinite PSNR, as between equal
        images, and for FLIP where flip-evaluator is not installed.

    Raises
    ------
    InputError
        If there is no view, a view's photo is not of its camera's size, or `out` cannot be written.
    """
    views, renderer = list(views), renderer or Renderer()
    about = {
        "num_gaussians": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "mode": renderer.config.mode,
    }
    return evaluate_images(rendered(gaussians, views, renderer), views, out, about, renderer.label, metrics)


def evaluate_images(
    images: Iterable[NDArray[np.uint8]],
    views: list[View],
    out: Path | str,
    about: dict[str, Any],
    device: str,
    metrics: Sequence[Metric] = METRICS,
) -> dict[str, Any]:
    """Compare images, one per view, with the photos, as `evaluate` does.

    Parameters
    ----------
    images : iterable of (H, W, 3) uint8
    views, out, metrics
        As given to `evaluate`.
    about : dict
        What made the images, for the result; for a field: method and model_bytes.
    device : str
        Name of the device.
    """
    kinds = ("truth", "render", "difference")
    out = Path(out)
    try:
        for kind in kinds:
            (out / kind).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create {out}: {error.strerror}") from error
    names = _file_names(views)

    def compare(index: int, view: View, image: NDArray[np.uint8]) -> dict[str, Any]:
        name = names[index]
        files = {kind: f"{kind}/{name}" for kind in kinds}
        save_png(out / files["truth"], view.image)
        save_png(out / files["render"], image)
        save_difference(out / files["difference"], image, view.image, view.mask)
        found = {metric.__name__: metric(image, view.image, view.mask) for metric in metrics}
        found = {name: None if value == math.inf else value for name, value in found.items()}
        size = {"width": view.camera.width, "height": view.camera.height}
        return {"name": view.name, **found, **size, **files}

    records = compared(compare, views, images)

    result = {
        "mean": {metric.__name__: mean_of([r[metric.__name__] for r in records]) for metric in metrics},
        **about,
        "resolution": ", ".join(sorted({f"{r['width']}x{r['height']}" for r in records})),
        "device": device,
        "views": records,
    }
    with replacing(out / "metrics.json") as file:
        file.write((json.dumps(result, indent=2, allow_nan=False) + "\n").encode())
    write_page(out / "index.html", result)
    return result


def rendered(gaussians: Gaussians | Stored, views: list[View], renderer: Renderer) -> Iterator[NDArray[np.uint8]]:
    """Render views in 8 bits, one after the other."""
    # A loop's variable would keep the last Gaussians in memory while the next ones are read.
    return map(lambda each: to_uint8(each.rgb), renderings(renderer, gaussians, [view.camera for view in views]))


def compared(
    compare: Callable[[int, View, NDArray[np.uint8]], Result],
    views: list[View],
    images: Iterable[NDArray[np.uint8]],
) -> list[Result]:
    """Call `compare` for each view, with its index, the view and its image in 8 bits, on threads; list the results.

    Raises
    ------
    InputError
        If there is no view, or a view's photo is not of its camera's size.
    """
    if not views:
        raise InputError("views: expected at least one view to evaluate, found none")
    for view in views:
        shape = view.camera.height, view.camera.width, 3
        if not view.ahead and view.image.shape != shape:  # photos that stream are decoded to the size of their camera
            raise InputError(f"{view.name}: expected a photo of its camera's size, {shape}, found {view.image.shape}")
    results: list[Result] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        waiting: deque[Future[Result]] = deque()
        for index, (view, image) in enumerate(zip(in_turn(views), images, strict=True)):
            waiting.append(pool.submit(compare, index, view, image))
            if len(waiting) > PENDING:  # each holds a photo and a render
                results.append(waiting.popleft().result())
        return results + [future.result() for future in waiting]


def mean_of(values: Sequence[float | None]) -> float | None:
    """The mean of figures of views; None if one is missing."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else None


def _file_names(views: list[View]) -> list[str]:
    """File names of PNGs for the views: valid in any file system and different from each other."""
    stems = (re.sub(r"[^\w.-]+", "_", without_suffix(view.name)).strip("._") or "view" for view in views)
    return [f"{stem}.png" for stem in distinct_stems(stems)]
