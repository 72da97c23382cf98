"""Photos of an object before a plain background, rendered from a scene: captures of docs/experiments/strategies.md.

python tests/training/measure_studio.py guitar.compressed.ply OUT
clsplat bench quality OUT:downscale=2 OUT:downscale=2:thin=4 --methods auto
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rendered_photos import write_photos

from clsplat.camera import Camera
from clsplat.formats import load_gaussians

WIDTH, HEIGHT, FOCAL = 640, 480, 560.0
BACKGROUND = (0.85, 0.85, 0.85)
UP = np.array([0.0, -1.0, 0.0])
RINGS = ((0.05, 1.25), (0.35, 1.15), (0.75, 1.0))
"""Heights and radii of the rings of cameras, in diagonals of the object."""

PER_RING = 20
WITHIN = (3, 97)
"""Percentiles of the Gaussians' places between which the object lies."""


def cameras(means: np.ndarray, rng: np.random.Generator) -> Iterator[Camera]:
    """Cameras on rings around the object, each a little off its place."""
    low, high = np.percentile(means.astype(float), WITHIN, axis=0)
    centre, size = (low + high) / 2, np.linalg.norm(high - low)
    east = np.array([1.0, 0.0, 0.0])
    north = np.cross(UP, east)
    for ring, (height, radius) in enumerate(RINGS):
        for k in range(PER_RING):
            turn = 2 * np.pi * (k + 0.37 * ring) / PER_RING + rng.normal(0, 0.02)
            arm = radius * size * (1 + rng.normal(0, 0.03)) * (np.cos(turn) * east + np.sin(turn) * north)
            position = centre + arm + height * size * UP
            yield Camera.look_at(position, centre + rng.normal(0, 0.03 * size, 3), UP, FOCAL, WIDTH, HEIGHT)


def main(scene: str, out: Path) -> None:
    """Write 60 photos with noise, and their poses as transforms.json."""
    gaussians, rng = load_gaussians(scene)[0], np.random.default_rng(0)
    write_photos(gaussians, cameras(gaussians.means, rng), BACKGROUND, rng, out)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
