"""Photos of a walk through streets under clouds, ray traced: the capture of docs/experiments/strategies.md.

PYTHONPATH=tests/blocks python tests/training/measure_walk.py OUT
clsplat bench quality OUT OUT:thin=2 OUT:thin=4 OUT:thin=8 --methods auto
"""

import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData, PlyElement
from town import PITCH, town

from clsplat.camera import Camera
from clsplat.demo.known_photos import FOCAL_35MM, expose
from clsplat.demo.ray_tracer import Solid, camera_rays, radiance, trace
from clsplat.demo.still_life import fractal
from clsplat.formats.ply_container import POSITION

Array = NDArray[np.float64]

COUNT, WIDTH, HEIGHT = 104, 240, 180
TURNS = 0.0, 1.0, -1.0
"""Angles between the path and the axes of three photos after each other, radians."""

POINTS, AMONG = 150, 600
"""Points of a photo, those of the largest gradients among random ones, as structure from motion would find them."""

NOISE = 0.004
"""Standard deviation of the points' depths, as a fraction of these."""

FARTHEST = 80.0
"""Largest depth of a point, m."""


def sky(directions: Array) -> Array:
    """Linear RGB (3, N) of a bright horizon, a blue zenith and clouds, in unit directions (3, N)."""
    up = np.clip(directions[2], 0.02, 1)
    blue = np.outer([0.75, 0.82, 0.92], 1 - up) + np.outer([0.25, 0.42, 0.8], up)
    plane = np.stack([*directions[:2] / (up + 0.25), 0 * up])
    cloud = 0.6 * np.clip(4 * fractal(2 * plane, 4) - 2, 0, 1)
    return blue * (1 - cloud) + 0.95 * cloud


def take_photo(camera: Camera, solids: list[Solid]) -> NDArray[np.uint8]:
    """Render a photo with two rays per pixel and axis."""
    y, x = np.meshgrid(*((np.arange(2 * n) + 0.5) / 2 for n in (camera.height, camera.width)), indexing="ij")
    rays = camera_rays(camera, x.ravel(), y.ravel())
    rgb = radiance(camera.position, rays, solids)
    beyond = trace(camera.position[:, None], rays, solids)[1] < 0
    rgb[:, beyond] = sky(rays[:, beyond])
    fine = rgb.T.reshape(camera.height, 2, camera.width, 2, 3)
    return np.rint(255 * expose(fine.mean(axis=(1, 3)))).astype(np.uint8)


def walk() -> list[Camera]:
    """Cameras in the streets around a block, at the height of eyes, ahead and to both sides, somewhat upwards."""
    rng = np.random.default_rng(0)
    fx = 0.8 * FOCAL_35MM * np.hypot(WIDTH, HEIGHT) / np.hypot(36, 24)
    corners = PITCH / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    cameras = []
    for k in range(COUNT):
        side, along = divmod(4 * k / COUNT, 1)
        start, end = corners[int(side) : int(side) + 2]
        ahead = (end - start) / PITCH
        turn = TURNS[k % 3] + rng.normal(0, 0.15)
        look = np.cos(turn) * ahead + np.sin(turn) * np.array([-ahead[1], ahead[0]])
        eye = start + along * (end - start) + rng.normal(0, 0.8, 2)
        height = 1.7 + rng.normal(0, 0.1)
        target = [*(eye + 15 * look), height + 4.5 + rng.normal()]
        cameras.append(Camera.look_at([*eye, height], target, [0, 0, 1], fx, WIDTH, HEIGHT))
    return cameras


def points_of(camera: Camera, photo: NDArray[np.uint8], solids: list[Solid], seed: int) -> list[tuple[float, ...]]:
    """Places, in world units, and colours of points that a photo shows."""
    rng = np.random.default_rng([1, seed])
    slopes = np.abs(np.gradient(photo.mean(axis=2))).sum(axis=0)
    x, y = rng.uniform(0, [[WIDTH], [HEIGHT]], (2, AMONG))
    chosen = np.argsort(-slopes[y.astype(int), x.astype(int)])[:POINTS]
    x, y = x[chosen], y[chosen]
    rays = camera_rays(camera, x, y)
    depths = trace(camera.position[:, None], rays, solids)[0] * (1 + rng.normal(0, NOISE, POINTS))
    seen = depths < FARTHEST
    places = (camera.position[:, None] + depths[seen] * rays[:, seen]).T
    return [(*p, *c) for p, c in zip(places, photo[y.astype(int), x.astype(int)][seen], strict=True)]


def main(out: Path) -> None:
    """Write photos, poses as transforms.json, and points of the photos that are not held out."""
    out.mkdir(parents=True, exist_ok=True)
    cameras, solids = walk(), town(60, seed=3)
    frames, points = [], []
    for k, camera in enumerate(cameras):
        photo = take_photo(camera, solids)
        Image.fromarray(photo).save(out / f"{k:04}.png")
        pose = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": f"{k:04}.png", "transform_matrix": pose.tolist()})
        points += points_of(camera, photo, solids, k) if k % 8 else []
    dtype = [(name, "f4") for name in POSITION] + [(name, "u1") for name in ("red", "green", "blue")]
    PlyData([PlyElement.describe(np.array(points, dtype), "vertex")]).write(out / "points.ply")
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (out / "transforms.json").write_text(json.dumps(lens | {"ply_file_path": "points.ply", "frames": frames}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
