"""Quality of a training in blocks beside one training at once: near the borders of the blocks, and elsewhere.

Usage: python tests/blocks/measure_seam.py DATA BLOCKS ONCE [-o PICTURE.png]

DATA is the dataset of the runs BLOCKS (with `--blocks`) and ONCE. In each held-out photo, each pixel belongs to the
block whose Gaussians have most of its compositing weight. The band is what lies at most `BAND` px from a pixel of
another block. Prints PSNR and SSIM of both runs in the band, elsewhere and in all, pooled over all held-out photos;
then the same for the pixels of which no block has `ALONE` of the weight. The picture shows the photo whose band is
largest: with the borders, both renders, and below them the photo and the absolute differences of both, `GAIN` times.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import maximum_filter, minimum_filter

from clsplat.blocks.jobs import read_job
from clsplat.blocks.whole import BLOCKS
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.dataset import load_scene
from clsplat.formats import load_gaussians
from clsplat.gaussians import Gaussians
from clsplat.metrics import ssim, to_uint8
from clsplat.renderer import Renderer, download
from clsplat.scene import View
from clsplat.training.presets import with_settings

BAND = 8
"""Half the width of the band around a border, px."""

ALONE = 0.9
"""Share of a pixel's weight above which the pixel is one block's."""

GAIN = 4
"""Factor on the differences in the picture."""

Array = NDArray[np.float64]


def boxes(run: Path) -> list[Any]:
    """The boxes of a run's blocks in the first and the last trainings."""
    paths = [path for path in sorted((run / BLOCKS).glob("*.json")) if not path.name.startswith("coarse")]
    return sorted(job.box for job in map(read_job, paths) if job.scene == job.far)


def shares(gaussians: Gaussians, cut: list[Any], renderer: Renderer, view: View) -> Array:
    """Shares (B, H, W) of blocks in the compositing weight of pixels."""
    run, found = renderer.forward(gaussians, view.camera, gradients=False), []
    for box in cut:
        marks = np.repeat(box.contains(gaussians.means)[:, None], 3, axis=1)
        image = renderer.recolored(run, renderer.upload("marks", marks))
        found.append(np.asarray(download(image.rgb)[:, :, 0], np.float64))
    return np.array(found) / np.maximum(np.sum(found, axis=0), 1e-6)


def near_border(block: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether a pixel of another block is at most `BAND` px away."""
    size = 2 * BAND + 1
    return np.asarray(maximum_filter(block, size) != minimum_filter(block, size))


def rendered(run: Gaussians, renderer: Renderer, view: View) -> NDArray[np.uint8]:
    """A render of 8 bits, as evaluations compare them."""
    return to_uint8(np.asarray(download(renderer.forward(run, view.camera, gradients=False).image.rgb), np.float64))


def measured(
    views: list[View], runs: list[Gaussians], cut: list[Any], renderer: Renderer
) -> Iterator[dict[str, Any]]:
    """Yield each photo with both renders, the squared errors of their pixels, its blocks and its bands."""
    for view in views:
        weight = shares(runs[0], cut, renderer, view)
        images = [rendered(run, renderer, view) for run in runs]
        yield {
            "view": view,
            "images": images,
            "block": weight.argmax(axis=0),
            "errors": [((image / 255.0 - view.image / 255.0) ** 2).mean(axis=2) for image in images],
            "band": near_border(weight.argmax(axis=0)),
            "shared": weight.max(axis=0) < ALONE,
        }


def table(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows for the pixels of each kind: their share, and PSNR and SSIM of both runs."""
    kinds = {
        "all": [np.ones_like(one["band"]) for one in found],
        "band": [one["band"] for one in found],
        "outside the band": [~one["band"] for one in found],
        "shared": [one["shared"] for one in found],
        "not shared": [~one["shared"] for one in found],
    }
    rows = []
    for name, masks in kinds.items():
        row: dict[str, Any] = {"pixels": name, "percent": round(100 * float(np.mean(masks)), 1)}
        counts = [int(mask.sum()) for mask in masks]
        for k, run in enumerate(("blocks", "once")):
            errors = [one["errors"][k][mask] for one, mask in zip(found, masks, strict=True)]
            similar = [
                ssim(one["images"][k], one["view"].image, mask) * count
                for one, mask, count in zip(found, masks, counts, strict=True)
                if count
            ]
            row[f"PSNR {run}"] = round(float(-10 * np.log10(np.mean(np.concatenate(errors)))), 2)
            row[f"SSIM {run}"] = round(sum(similar) / sum(counts), 4)
        rows.append(row)
    return rows


def picture(one: dict[str, Any]) -> Image.Image:
    """The photo with the borders, renders in blocks and at once, and their differences from the photo below."""
    photo = one["view"].image
    marked = photo.copy()
    marked[maximum_filter(one["block"], 3) != minimum_filter(one["block"], 3)] = (255, 0, 255)
    wrong = [np.clip(GAIN * np.abs(i.astype(int) - photo), 0, 255).astype(np.uint8) for i in one["images"]]
    return Image.fromarray(np.vstack([np.hstack([marked, *one["images"]]), np.hstack([photo, *wrong])]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("blocks", type=Path)
    parser.add_argument("once", type=Path)
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    settings = options.blocks / "config.json"
    given = json.loads(settings.read_text())
    del given["data_path"]
    config = with_settings(TrainConfig(), given, str(settings))
    scene = load_scene(options.data, config.data)
    runs = [load_gaussians(run / "scene.ply")[0] for run in (options.blocks, options.once)]
    for run in runs:
        run.means[:] -= scene.offset
    renderer = Renderer(None, config.render, BACKGROUNDS[config.data.background])
    found = list(measured(scene.test, runs, boxes(options.blocks), renderer))
    for row in table(found):
        print(json.dumps(row))
    if options.out:
        picture(max(found, key=lambda one: one["band"].mean())).save(options.out)


if __name__ == "__main__":
    main()
