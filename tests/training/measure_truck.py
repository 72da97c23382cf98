"""Photos of a truck under the sky, rendered from a public scene: the capture of docs/experiments/strategies.md.

python tests/training/measure_truck.py truck.splat truck.splat.cameras.json OUT
clsplat bench quality OUT:downscale=2 OUT:downscale=2:thin=2 OUT:downscale=2:thin=4 --methods auto
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from clsplat import render
from clsplat.camera import Camera
from clsplat.formats import load_gaussians

WIDTH, HEIGHT, FOCAL = 800, 600, 528.0
SKY = (0.6, 0.7, 0.8)
NOISE = 0.008
RINGS = ((0.0, 1.0), (0.12, 1.0), (0.3, 0.9))
"""Heights and radii of the rings of cameras, in distances of the given views from the point that they look at."""

PER_RING = 20

NEAR = 0.25
"""Depth of the photos' near plane, in distances of the given views from the point that they look at. Nearer are faint
Gaussians of the scene alone, which no photo of the truck shows."""


def main(scene: str, views: str, out: Path) -> None:
    """Write 60 photos with noise, and their poses as transforms.json."""
    gaussians = load_gaussians(scene)[0]
    given = json.loads(Path(views).read_text())
    matrices = np.array([view["world_to_camera"] for view in given["views"]])
    ahead, places = matrices[:, 2, :3], -np.einsum("nij,ni->nj", matrices[:, :3, :3], matrices[:, :3, 3])
    across = np.eye(3) - np.einsum("ni,nj->nij", ahead, ahead)
    centre = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, places))
    up = np.array(given["up"], float)
    radius = np.linalg.norm(places - centre, axis=1).mean()
    east = np.cross(up, [1, 0, 0.1])
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    (out / "images").mkdir(parents=True, exist_ok=True)
    rng, frames = np.random.default_rng(0), []
    for ring, (height, wide) in enumerate(RINGS):
        for k in range(PER_RING):
            turn = 2 * np.pi * (k + 0.37 * ring) / PER_RING + rng.normal(0, 0.02)
            arm = wide * radius * (1 + rng.normal(0, 0.03)) * (np.cos(turn) * east + np.sin(turn) * north)
            position = centre + arm + height * radius * up
            target = centre + rng.normal(0, 0.04 * radius, 3)
            camera = Camera.look_at(position, target, up, FOCAL, WIDTH, HEIGHT)
            camera = replace(camera, near=NEAR * radius)
            image = np.asarray(render(gaussians, camera, background=SKY, gradients=False).rgb)
            image = np.clip(image + rng.normal(0, NOISE, image.shape), 0, 1)
            name = f"images/{len(frames):04d}.png"
            Image.fromarray((255 * image + 0.5).astype(np.uint8)).save(out / name)
            pose = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
            frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (out / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
