"""Make the pictures of levels of detail in docs/howto/works-with.md: a walk through a scene in viewers of others.

    $ PYTHONPATH=tests/show:tests/formats python tests/formats/make_levels_shown.py SCENE --data DATASET --out FOLDER

The scene is exported in levels of detail. The camera of the dataset's first held-out photo walks away from the scene
in `STEPS` steps. PlayCanvas may draw `SHARE` of the splats, CesiumJS those whose error is `PIXELS` on the screen.
What they draw, and PSNRs against our render of the finest level, are in levels.json.
"""

import json
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from browser import browser
from foreign_code import PACKAGES
from PIL import Image
from viewers import VIEWERS, picture_address, pose_of, served

from clsplat import load_gaussians, load_scene, render
from clsplat.camera import Camera
from clsplat.commands.files import Export
from clsplat.config import DataConfig
from clsplat.formats.streamed_sog import LOD_META
from clsplat.formats.tiles_3d import TILESET
from clsplat.metrics import psnr, to_uint8

STEPS = (1.0, 2.0, 4.0)
"""Distances of the camera from what it looks at, relative to that of the photo."""

SHARE = 0.6
"""Budget of PlayCanvas, as a fraction of the scene's splats."""

PIXELS = 4.0
"""Error that CesiumJS allows, px."""

SHOWN = {"playcanvas": LOD_META, "cesium": TILESET}

PATIENCE = 600.0
"""Longest time for a picture, s, and the time for which it must not change: a machine without a GPU is slow."""
STILL = 20.0


def walk(camera: Camera, focus: np.ndarray) -> list[Camera]:
    """The camera at each of the steps away from a point."""
    cameras = []
    for step in STEPS:
        viewmat = camera.viewmat.copy()
        eye = focus + step * (camera.position - focus)
        viewmat[:3, 3] = -viewmat[:3, :3] @ eye
        cameras.append(replace(camera, viewmat=viewmat))
    return cameras


def settled(page: object, expected: np.ndarray) -> tuple[np.ndarray, int]:
    """The picture of a page and the number of its splats, once neither changes for a while."""
    begin = changed = time.monotonic()
    before: tuple[float, int] = (0.0, -1)
    while time.monotonic() - changed < STILL or before[1] < 1:
        if time.monotonic() - begin > PATIENCE:
            raise SystemExit(f"waited {PATIENCE} s for a picture; the page says: {page.log[-3:]}")
        time.sleep(1)
        picture = page.screenshot()
        now = round(psnr(picture, expected), 2), int(page.evaluate("window.splats ? window.splats() || 0 : 0"))
        if now != before:
            before, changed = now, time.monotonic()
    return picture, before[1]


def main(scene: Path, data: Path, out: Path, downscale: int = 1) -> None:
    """Make the pictures in the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    camera = load_scene(data, DataConfig(downscale=downscale)).test[0].camera
    camera = replace(camera, fx=camera.fy)  # viewers have one focal length
    found: dict[str, dict[str, object]] = {}
    with tempfile.TemporaryDirectory() as folder, served(Path(folder)) as address:
        Export(scene, Path(folder) / "levels").run()
        count = len(load_gaussians(scene)[0])
        limits = {"playcanvas": SHARE * count, "cesium": PIXELS}
        for viewer, name in SHOWN.items():
            gaussians = load_gaussians(Path(folder) / "levels" / name)[0]
            cameras = walk(camera, np.median(gaussians.means, axis=0))
            url = picture_address(address, viewer, f"levels/{name}", cameras[0], limits[viewer])
            rows, steps = [], []
            with browser(Path(folder) / f"profile of {viewer}", url, camera.width, camera.height) as page:
                for each in cameras:
                    ours = to_uint8(render(gaussians, each).rgb)
                    page.evaluate(f"window.place && window.place({pose_of(viewer, name, each)})")
                    picture, splats = settled(page, ours)
                    rows.append(np.concatenate([ours, picture]))
                    steps.append({"splats": splats, "PSNR": round(psnr(picture, ours), 2)})
                    print(viewer, steps[-1], file=sys.stderr)
            Image.fromarray(np.concatenate(rows, axis=1)).save(out / f"levels_{viewer}.jpg", quality=92)
            version = json.loads((PACKAGES / VIEWERS[viewer].package / "package.json").read_text())["version"]
            found[VIEWERS[viewer].label] = {"version": version, "of": count, "limit": limits[viewer], "steps": steps}
            (out / "levels.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
