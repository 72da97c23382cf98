"""Photos of a truck under the sky, rendered from a public scene: the capture of docs/experiments/strategies.md.

python tests/training/measure_truck.py truck.splat truck.splat.cameras.json OUT
clsplat bench quality OUT:downscale=2 OUT:downscale=2:thin=2 OUT:downscale=2:thin=4 --methods auto
"""

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rendered_photos import write_photos

from clsplat.camera import Camera
from clsplat.formats import load_gaussians

WIDTH, HEIGHT, FOCAL = 800, 600, 528.0
SKY = (0.6, 0.7, 0.8)
RINGS = ((0.0, 1.0), (0.12, 1.0), (0.3, 0.9))
"""Heights and radii of the rings of cameras, in distances of the given views from the point that they look at."""

PER_RING = 20

NEAR = 0.25
"""Depth of the photos' near plane, in distances of the given views from the point that they look at. Nearer are faint
Gaussians of the scene alone, which no photo of the truck shows."""


def cameras(views: str, rng: np.random.Generator) -> Iterator[Camera]:
    """Cameras on rings around the point at which given views look, each a little off its place."""
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
    for ring, (height, wide) in enumerate(RINGS):
        for k in range(PER_RING):
            turn = 2 * np.pi * (k + 0.37 * ring) / PER_RING + rng.normal(0, 0.02)
            arm = wide * radius * (1 + rng.normal(0, 0.03)) * (np.cos(turn) * east + np.sin(turn) * north)
            position = centre + arm + height * radius * up
            target = centre + rng.normal(0, 0.04 * radius, 3)
            camera = Camera.look_at(position, target, up, FOCAL, WIDTH, HEIGHT)
            yield replace(camera, near=NEAR * radius)


def main(scene: str, views: str, out: Path) -> None:
    """Write 60 photos with noise, and their poses as transforms.json."""
    rng = np.random.default_rng(0)
    write_photos(load_gaussians(scene)[0], cameras(views, rng), SKY, rng, out)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], Path(sys.argv[3]))
