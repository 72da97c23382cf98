"""Photos of an object before a plain background, rendered from a scene: captures of docs/experiments/strategies.md.

python tests/training/measure_studio.py guitar.compressed.ply OUT
clsplat bench quality OUT:downscale=2 OUT:downscale=2:thin=4 --methods auto
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from clsplat import render
from clsplat.camera import Camera
from clsplat.formats import load_gaussians

WIDTH, HEIGHT, FOCAL = 640, 480, 560.0
BACKGROUND = (0.85, 0.85, 0.85)
NOISE = 0.008
UP = np.array([0.0, -1.0, 0.0])
RINGS = ((0.05, 1.25), (0.35, 1.15), (0.75, 1.0))
"""Heights and radii of the rings of cameras, in diagonals of the object."""

PER_RING = 20
WITHIN = (3, 97)
"""Percentiles of the Gaussians' places between which the object lies."""


def main(scene: str, out: Path) -> None:
    """Write 60 photos with noise, and their poses as transforms.json."""
    gaussians = load_gaussians(scene)[0]
    low, high = np.percentile(gaussians.means.astype(float), WITHIN, axis=0)
    centre, size = (low + high) / 2, np.linalg.norm(high - low)
    east = np.array([1.0, 0.0, 0.0])
    north = np.cross(UP, east)
    (out / "images").mkdir(parents=True, exist_ok=True)
    rng, frames = np.random.default_rng(0), []
    for ring, (height, radius) in enumerate(RINGS):
        for k in range(PER_RING):
            turn = 2 * np.pi * (k + 0.37 * ring) / PER_RING + rng.normal(0, 0.02)
            arm = radius * size * (1 + rng.normal(0, 0.03)) * (np.cos(turn) * east + np.sin(turn) * north)
            target = centre + rng.normal(0, 0.03 * size, 3)
            camera = Camera.look_at(centre + arm + height * size * UP, target, UP, FOCAL, WIDTH, HEIGHT)
            image = np.asarray(render(gaussians, camera, background=BACKGROUND, gradients=False).rgb)
            image = np.clip(image + rng.normal(0, NOISE, image.shape), 0, 1)
            name = f"images/{len(frames):04d}.png"
            Image.fromarray((255 * image + 0.5).astype(np.uint8)).save(out / name)
            pose = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
            frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (out / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
