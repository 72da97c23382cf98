"""Evaluation: render views, compare them with their photos, and leave figures and a page to look at."""

import json
import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import RenderConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.metrics import flip, psnr, ssim, to_uint8
from clsplat.render import render
from clsplat.report import save_difference, save_png, write_page
from clsplat.scene import View

if TYPE_CHECKING:
    from clsplat.device import Device

Color = tuple[float, float, float]


def mean_metrics(
    gaussians: Gaussians,
    views: Iterable[View],
    config: RenderConfig = RenderConfig(),
    device: "Device | None" = None,
    background: Color = (0.0, 0.0, 0.0),
) -> dict[str, float]:
    """Mean PSNR and SSIM over views, for the log of a training run; parameters as of `evaluate`.

    Returns
    -------
    dict
        psnr in decibels, ssim.
    """
    images = list(_renders(gaussians, views, config, device, background))
    return {
        "psnr": float(np.mean([psnr(image, view.image, view.mask) for view, image in images])),
        "ssim": float(np.mean([ssim(image, view.image, view.mask) for view, image in images])),
    }


def evaluate(
    gaussians: Gaussians,
    views: Iterable[View],
    out: Path,
    config: RenderConfig = RenderConfig(),
    device: "Device | None" = None,
    background: Color = (0.0, 0.0, 0.0),
) -> dict[str, Any]:
    """Render views and compare them with their photos.

    Parameters
    ----------
    gaussians : Gaussians
        In the coordinates of the views.
    views : iterable of View
        At least one; usually a scene's held-out views.
    out : Path
        Folder, made where it is missing, for metrics.json, index.html, and the pictures in truth/, render/ and
        difference/.
    config : RenderConfig
    device : Device, optional
        None renders with the float64 twins.
    background : (3,) floats
        RGB behind the Gaussians: that of the photos where they were transparent.

    Returns
    -------
    dict
        The content of metrics.json. ``mean`` holds psnr (dB), ssim and flip: the means of the views' figures;
        ``views`` has those of each view, its size and the paths of its pictures. None (null) stands for a PSNR
        that is infinite, as between equal images, and for FLIP where flip-evaluator is not installed.

    Raises
    ------
    InputError
        If there is no view, a view's photo is not of its camera's size, or `out` cannot be written.
    """
    kinds = ("truth", "render", "difference")
    try:
        for kind in kinds:
            (out / kind).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a folder that can be written to, found: {error.strerror}") from error
    records: list[dict[str, Any]] = []
    taken: set[str] = set()
    for view, image in _renders(gaussians, views, config, device, background):
        name = _file_name(view.name, taken)
        files = {kind: f"{kind}/{name}" for kind in kinds}
        save_png(out / files["truth"], view.image)
        save_png(out / files["render"], image)
        save_difference(out / files["difference"], image, view.image, view.mask)
        metrics = {metric.__name__: metric(image, view.image, view.mask) for metric in (psnr, ssim, flip)}
        if metrics["psnr"] == math.inf:
            metrics["psnr"] = None
        size = {"width": view.camera.width, "height": view.camera.height}
        records.append({"name": view.name, **metrics, **size, **files})

    def mean(metric: str) -> float | None:
        values = [record[metric] for record in records]
        return None if None in values else float(np.mean(values))

    result = {
        "mean": {metric: mean(metric) for metric in ("psnr", "ssim", "flip")},
        "num_gaussians": len(gaussians),
        "sh_degree": gaussians.sh_degree,
        "mode": config.mode,
        "resolution": ", ".join(sorted({f"{r['width']}x{r['height']}" for r in records})),
        "device": "float64 reference, no OpenCL" if device is None else device.label,
        "views": records,
    }
    with replacing(out / "metrics.json") as file:
        file.write((json.dumps(result, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode())
    write_page(out / "index.html", result)
    return result


def _renders(
    gaussians: Gaussians, views: Iterable[View], config: RenderConfig, device: "Device | None", background: Color
) -> Iterator[tuple[View, NDArray[np.uint8]]]:
    """Each view with its render, rounded to 8 bits."""
    count = 0
    for view in views:
        camera = view.camera
        if view.image.shape != (camera.height, camera.width, 3):
            raise InputError(
                f"{view.name}: expected a photo of its camera's size, {(camera.height, camera.width, 3)}, "
                f"found {view.image.shape}"
            )
        yield view, to_uint8(render(gaussians, camera, config, device, background=background).rgb)
        count += 1
    if count == 0:
        raise InputError("views: expected at least one view to evaluate, found none")


def _file_name(name: str, taken: set[str]) -> str:
    """A PNG's name for a view: safe in any file system and unlike those in `taken`, to which it is added."""
    stem = re.sub(r"[^\w.-]+", "_", str(PurePosixPath(name).with_suffix(""))).strip("._")[:100] or "view"
    while stem.casefold() in taken:
        stem += "_"
    taken.add(stem.casefold())
    return f"{stem}.png"
