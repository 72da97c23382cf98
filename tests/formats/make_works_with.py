"""Make the pictures of docs/howto/works-with.md: one view of a scene in viewers that are not ours, and our render.

    $ make works-with SCENE=scene.ply DATA=dataset

The dataset's first held-out photo is the view. PSNRs against our render of the same file are in works_with.json.
"""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from browser import browser, wait_for
from foreign_code import PACKAGES
from PIL import Image
from viewers import VIEWERS, picture_address, served

from clsplat import load_gaussians, load_scene, render, save_gaussians
from clsplat.config import DataConfig
from clsplat.metrics import psnr, to_uint8

SHOWN = {"playcanvas": "scene.sog", "spark": "scene.spz", "babylon": "scene.glb", "mkkellogg": "scene.splat"}
"""A file for each viewer: the most compact of those that it reads with view-dependent colours, where there is one."""

DB_MIN = 25.0
"""PSNR from which a viewer has loaded the scene, dB. Before, it shows a background."""

SETTLED = 0.01
"""Difference of the PSNR of two pictures in a row of a viewer that has sorted its splats, dB."""


def main(scene: Path, data: Path, out: Path, downscale: int = 1) -> None:
    """Make the pictures in the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    camera = load_scene(data, DataConfig(downscale=downscale)).test[0].camera
    # Viewers have one focal length, and look at the middle of the picture.
    camera = replace(camera, fx=camera.fy, cx=camera.width / 2, cy=camera.height / 2)
    gaussians = load_gaussians(scene)[0]
    found: dict[str, dict[str, object]] = {}
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as address:
        ours = to_uint8(render(gaussians, camera).rgb)
        Image.fromarray(ours).save(out / "clsplat.jpg", quality=92)
        for viewer, name in SHOWN.items():
            save_gaussians(Path(folder) / name, gaussians)
            same = to_uint8(render(load_gaussians(Path(folder) / name)[0], camera).rgb)
            picture = shown(
                Path(folder) / f"profile of {viewer}", picture_address(address, viewer, name, camera), same
            )
            Image.fromarray(picture).save(out / f"{viewer}.jpg", quality=92)
            about = json.loads((PACKAGES / VIEWERS[viewer].package / "package.json").read_text())
            found[VIEWERS[viewer].label] = {
                "version": about["version"],
                "file": name,
                "bytes": (Path(folder) / name).stat().st_size,
                "PSNR against clsplat's render of the file": round(psnr(picture, same), 2),
            }
            print(VIEWERS[viewer].label, found[VIEWERS[viewer].label], file=sys.stderr)
    (out / "works_with.json").write_text(json.dumps(found, indent=1) + "\n")


def shown(profile: Path, url: str, expected: np.ndarray) -> np.ndarray:
    """The picture of a page, as soon as it no longer changes."""
    height, width = expected.shape[:2]
    with browser(profile, url, width, height) as page:
        wait_for(lambda: psnr(page.screenshot(), expected) > DB_MIN, f"the scene to appear: {page.log[-2:]}")
        levels = [0.0]

        def settled() -> bool:
            levels.append(psnr(page.screenshot(), expected))
            return abs(levels[-1] - levels[-2]) < SETTLED

        wait_for(settled, "the picture to stay")
        return page.screenshot()


if __name__ == "__main__":
    tyro.cli(main)
