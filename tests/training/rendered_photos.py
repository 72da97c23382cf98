"""Photos with noise, rendered from Gaussians, as a dataset with poses: for scripts that measure captures."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from clsplat import render
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.scene import Color

NOISE = 0.008
"""Standard deviation of a pixel, as a fraction of white: two levels of 8 bits."""


def write_photos(
    gaussians: Gaussians, cameras: Iterable[Camera], background: Color, rng: np.random.Generator, out: Path
) -> None:
    """Render a photo for each camera, all with the same lens, and write photos and transforms.json to a folder."""
    (out / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for k, camera in enumerate(cameras):
        image = np.asarray(render(gaussians, camera, background=background, gradients=False).rgb)
        image = np.clip(image + rng.normal(0, NOISE, image.shape), 0, 1)
        name = f"images/{k:04d}.png"
        Image.fromarray((255 * image + 0.5).astype(np.uint8)).save(out / name)
        pose = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    size = {"w": camera.width, "h": camera.height}
    (out / "transforms.json").write_text(json.dumps({**lens, **size, "frames": frames}))
