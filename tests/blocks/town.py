"""A town from the air, ray traced: photos with known cameras, of streets and courtyards that hide each other.

The town grows with the number of photos: each shows about as much of it, whatever their number.
"""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from clsplat.camera import Camera
from clsplat.demo.known_photos import FOCAL_35MM, take_photo
from clsplat.demo.ray_tracer import Solid, Texture, bake, camera_rays, trace
from clsplat.demo.shapes import Cube, Sphere, Square
from clsplat.demo.still_life import cell_random, cells, edge, fractal, linear, mix, peel, ramp
from clsplat.formats.ply_container import POSITION

Array = NDArray[np.float64]

PITCH, STREET, WING = 34.0, 10.0, 7.0
"""From one block of houses to the next, width of a street, and depth of a house, m."""

FLIGHT, STEP, AHEAD = 60.0, 17.0, 30.0
"""Height of the camera, distance of two photos, and how far ahead of it four of five photos look, m. Neighbouring
photos share about two thirds of what they show."""

POINTS = 25
"""Points of a photo, as structure from motion would find them."""


def house(size: tuple[float, float, float], plaster: str) -> Texture:
    """Walls with windows, and a roof of tiles."""

    def texture(p: Array) -> Array:
        across = np.where(np.abs(p[0]) > size[0] - 1e-3, p[1], p[0])
        row, column, border = cells(across + 50, p[2] + 50, 2.2, 2.8, 0.0)
        wall = linear(plaster) * (0.7 + 0.5 * fractal(p * 0.5))
        glass = ramp(cell_random(row, column), "1d2630", "5b6f80", "d8d3b8")
        wall = mix(wall, glass, edge(border - 0.55, 0.2))
        tiles = ramp(0.6 * fractal(p * 0.9, 2) + 0.4 * fractal(p * 0.15, 2), "5a2f25", "9a5138", "b98a6a", "6f6a66")
        return np.where(p[2] > size[2] - 1e-3, tiles, wall)

    return texture


def street(p: Array) -> Array:
    """Asphalt with a dashed line in the middle, and grass in the courtyards."""
    asphalt = ramp(fractal(p * 0.6, 2), "3a3a3c", "5c5a58", "77736d")
    x, y = ((a + PITCH / 2) % PITCH - PITCH / 2 for a in p[:2])
    dash = (np.minimum(PITCH / 2 - np.abs(x), PITCH / 2 - np.abs(y)) < 0.25) & (np.floor((p[0] + p[1]) / 2) % 2 == 0)
    inner = np.maximum(np.abs(x), np.abs(y)) < (PITCH - STREET) / 2
    grass = ramp(fractal(p * 0.8, 3), "2c3f1c", "55702f", "8a9a55")
    return mix(mix(asphalt, linear("d8d4c8"), dash), grass, inner)


def town(side: float, seed: int = 0) -> list[Solid]:
    """Blocks of four houses around a courtyard with trees, on a square of `side` metres; lit."""
    rng = np.random.default_rng(seed)
    count = int(np.ceil(side / PITCH / 2)) + 1  # photos at the edge show a block more
    reach = (count + 0.5) * PITCH
    solids = [Solid(Square(), street, (0, 0, 0), reach, texels=16 * count)]
    wide = (PITCH - STREET) / 2
    tree = peel("22351a", "47632b", "7d8f4a")
    for i in range(-count, count + 1):
        for j in range(-count, count + 1):
            middle = np.array([i * PITCH, j * PITCH, 0])
            for k, turn in enumerate(((0, 1), (1, 0), (0, -1), (-1, 0))):
                height = rng.uniform(4, 10) if rng.random() < 0.9 else rng.uniform(12, 18)
                half = (wide, WING / 2, height) if k % 2 == 0 else (WING / 2, wide - WING, height)
                place = middle + np.array([*np.array(turn) * (wide - WING / 2), height])
                colour = "".join(f"{c:02x}" for c in rng.integers((120, 110, 90), (235, 215, 190)))
                solids.append(Solid(Cube(), house(half, colour), place, half, texels=8))
            for _ in range(2):
                radius = rng.uniform(1.2, 2.5)
                place = middle + np.array([*rng.uniform(-3, 3, 2), radius + 0.5])
                solids.append(Solid(Sphere(), tree, place, radius, texels=8))
    bake(solids, sun_rays=2, sky_rays=12)
    return solids


def flight(count: int, width: int, height: int, seed: int = 0) -> tuple[list[Camera], float]:
    """Cameras on a grid in the order of the flight, one of five looking down; and the side of the grid, m."""
    rng = np.random.default_rng(seed)
    fx = FOCAL_35MM * np.hypot(width, height) / np.hypot(36, 24)
    side = int(np.ceil(np.sqrt(count)))
    cameras = []
    for k in range(count):
        row, column = divmod(k, side)
        column = column if row % 2 == 0 else side - 1 - column
        eye = STEP * (np.array([column, row]) - (side - 1) / 2) + rng.normal(0, 1, 2)
        turn = np.pi / 2 * (k % 5) + rng.normal(0, 0.2)
        ahead = 1e-3 if k % 5 == 4 else AHEAD
        target = eye + ahead * np.array([np.cos(turn), np.sin(turn)])
        cameras.append(Camera.look_at([*eye, FLIGHT + rng.normal(0, 2)], [*target, 5], [0, 0, 1], fx, width, height))
    return cameras, side * STEP


def write_town(folder: Path, count: int, width: int = 120, height: int = 90) -> None:
    """Write a transforms.json, photos and points of a town; photos that are there are kept."""
    from plyfile import PlyData, PlyElement

    folder.mkdir(parents=True, exist_ok=True)
    cameras, side = flight(count, width, height)
    solids = town(side)
    frames, points = [], []
    for k, camera in enumerate(cameras):
        name = f"{k:04}.png"
        if not (folder / name).exists():
            photo = Image.fromarray(np.rint(255 * take_photo(camera, solids)).astype(np.uint8))
            photo.save(folder / "part.png")
            (folder / "part.png").replace(folder / name)
        pose = np.linalg.inv(camera.viewmat) @ np.diag([1, -1, -1, 1])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        rng = np.random.default_rng([1, k])
        x, y = rng.uniform(0, [[width], [height]], (2, POINTS))
        rays = camera_rays(camera, x, y)
        t, _ = trace(camera.position[:, None], rays, solids)
        colors = np.asarray(Image.open(folder / name))[y.astype(int), x.astype(int)]
        places = (camera.position[:, None] + t * rays).T
        points += [(*place, *color) for place, color in zip(places, colors, strict=True) if np.isfinite(place).all()]
    dtype = [(name, "f4") for name in POSITION] + [(name, "u1") for name in ("red", "green", "blue")]
    PlyData([PlyElement.describe(np.array(points, dtype), "vertex")]).write(folder / "points.ply")
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    lens["ply_file_path"] = "points.ply"
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
