"""Make the pictures of levels of detail in docs/howto/works-with.md: a walk through a scene in viewers of others.

    $ PYTHONPATH=tests/show:tests/formats python tests/formats/make_levels_shown.py --scene FILE --data DATASET \
        --out FOLDER

The scene is exported in levels of detail. The camera of the dataset's first held-out photo walks away from the scene
in `STEPS` steps. PlayCanvas and SuperSplat's viewer, which clsplat contains, may draw a share of the splats, CesiumJS
those whose error is `PIXELS` on the screen. The scene is turned so that the camera is upright: SuperSplat's viewer
keeps the horizon level. What they draw, and PSNRs against our render of the finest level, are in levels.json.
"""

import gzip
import json
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from browser import browser
from foreign_code import PACKAGES
from PIL import Image
from viewers import VIEWERS, picture_address, pose_of, served

from clsplat import load_gaussians, load_scene, render, save_gaussians
from clsplat.camera import Camera
from clsplat.commands.files import Export
from clsplat.config import DataConfig
from clsplat.formats.axes import rotated
from clsplat.formats.streamed_sog import LOD_META
from clsplat.formats.tiles_3d import TILESET
from clsplat.metrics import psnr, to_uint8
from clsplat.show.camera_paths import Viewpoint
from clsplat.show.web_page import VENDOR, upright, viewer_settings

STEPS = (1.0, 2.0, 4.0)
"""Distances of the camera from what it looks at, relative to that of the photo."""

PIXELS = 4.0
"""Error that CesiumJS allows, px."""

SHOWN = {"playcanvas": LOD_META, "supersplat": LOD_META, "cesium": TILESET}

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


def supersplat(folder: Path, address: str, name: str, at: Viewpoint, budget: float) -> str:
    """Write the page of SuperSplat's viewer and its settings into the folder; return the page's address."""
    (folder / "supersplat.html").write_bytes(gzip.decompress((VENDOR / "supersplat-viewer.html.gz").read_bytes()))
    (folder / "settings.json").write_text(json.dumps(viewer_settings(at, np.eye(3), "black")))
    millions = budget / 1e6
    return f"{address}/supersplat.html?webgl&noui&noanim&settings=/settings.json&content=/{name}&budget={millions}"


def pictures(
    folder: Path, address: str, viewer: str, cameras: list[Camera], focus: np.ndarray, limit: float, ours: list[Any]
) -> Iterator[tuple[np.ndarray, int]]:
    """The picture of each camera in a viewer, and the number of splats that it drew."""
    name = f"levels/{SHOWN[viewer]}"
    if viewer == "supersplat":  # one page for each camera: the viewer has no other way to place it
        for k, (camera, expected) in enumerate(zip(cameras, ours, strict=True)):
            at = Viewpoint(camera, focus, -camera.viewmat[1, :3])
            url = supersplat(folder, address, name, at, limit)
            with browser(folder / f"profile {k}", url, camera.width, camera.height) as page:
                page.evaluate("window.splats = () => window.app?.stats.frame.gsplats")
                yield settled(page, expected)
        return
    url = picture_address(address, viewer, name, cameras[0], limit)
    with browser(folder / f"profile of {viewer}", url, cameras[0].width, cameras[0].height) as page:
        for camera, expected in zip(cameras, ours, strict=True):
            page.evaluate(f"window.place && window.place({pose_of(viewer, name, camera)})")
            yield settled(page, expected)


def version(viewer: str) -> str:
    """Version of a viewer."""
    if viewer == "supersplat":
        return re.findall(r"SuperSplat Viewer ([0-9.]+)", (VENDOR / "README.md").read_text())[0]
    return str(json.loads((PACKAGES / VIEWERS[viewer].package / "package.json").read_text())["version"])


def main(
    scene: Path,
    data: Path,
    out: Path,
    downscale: int = 1,
    share: float = 0.6,
    viewers: tuple[str, ...] = tuple(SHOWN),
) -> None:
    """Make the pictures in the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    camera = load_scene(data, DataConfig(downscale=downscale)).test[0].camera
    # Viewers have one focal length, and look at the middle of the picture.
    camera = replace(camera, fx=camera.fy, cx=camera.width / 2, cy=camera.height / 2)
    turn = np.eye(4)
    turn[:3, :3] = upright(-camera.viewmat[1, :3])
    camera = replace(camera, viewmat=camera.viewmat @ turn.T)
    found: dict[str, dict[str, object]] = {}
    with tempfile.TemporaryDirectory() as name, served(Path(name)) as address:
        folder = Path(name)
        save_gaussians(folder / "scene.ply", rotated(load_gaussians(scene)[0], turn[:3, :3]))
        Export(folder / "scene.ply", folder / "levels").run()
        for viewer in viewers:
            gaussians = load_gaussians(folder / "levels" / SHOWN[viewer])[0]
            focus = np.median(gaussians.means, axis=0)
            cameras = walk(camera, focus)
            limit = PIXELS if viewer == "cesium" else share * len(gaussians)
            ours = [to_uint8(render(gaussians, each).rgb) for each in cameras]
            rows, steps = [], []
            shown = pictures(folder, address, viewer, cameras, focus, limit, ours)
            for (picture, splats), expected in zip(shown, ours, strict=True):
                rows.append(np.concatenate([expected, picture]))
                steps.append({"splats": splats, "PSNR": round(psnr(picture, expected), 2)})
                print(viewer, steps[-1], file=sys.stderr)
            Image.fromarray(np.concatenate(rows, axis=1)).save(out / f"levels_{viewer}.jpg", quality=92)
            found[viewer] = {"version": version(viewer), "of": len(gaussians), "limit": limit, "steps": steps}
            (out / "levels.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
