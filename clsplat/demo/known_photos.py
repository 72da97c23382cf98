"""Photos of the still life from known cameras: as files, or as a scene in memory."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from clsplat.atomic import replacing
from clsplat.camera import Camera
from clsplat.demo.ray_tracer import Solid, bake, camera_rays, radiance, trace
from clsplat.demo.shapes import Array
from clsplat.demo.still_life import still_life
from clsplat.errors import InputError
from clsplat.scene import Scene, View

SENSOR_NOISE = 0.005
"""Standard deviation of the sensor's noise, in sRGB of full scale 1: a good camera in daylight."""

TILE = 128
"""Edge of the squares of a photo that are traced at once, rays. Their arrays fit into a core's cache."""

FOCAL_35MM = 35
"""Focal length of the 35 mm camera with the same diagonal field of view, mm. The EXIF data of the photos contain
it."""


def viewpoints(count: int, width: int, height: int, rng: np.random.Generator) -> list[Camera]:
    """Cameras around the scene: two thirds on a low ring, the others on a high ring."""
    fx = FOCAL_35MM * np.hypot(width, height) / np.hypot(36, 24)
    low = count - count // 3
    turns = np.concatenate([np.arange(low) / low, (np.arange(count - low) + 0.25) / max(count - low, 1)])
    cameras = []
    for k, turn in enumerate(turns):
        angle = 2 * np.pi * turn + rng.normal(0, 0.03)
        radius, z = np.array([2.95, 1.75] if k < low else [2.3, 2.65]) + rng.normal(0, 0.1, 2)
        eye = np.array([radius * np.cos(angle), radius * np.sin(angle), z])
        cameras.append(Camera.look_at(eye, rng.normal([0, 0, 0.25], 0.05), (0, 0, 1), fx, width, height))
    return cameras


def expose(rgb: Array) -> Array:
    """Convert linear radiance to sRGB in [0, 1].

    Highlights are compressed less than by Reinhard et al. 2002, equation 4. The three numbers were chosen by eye:
    sunlit white cloth stays below 1, and shadows keep their colours.
    """
    x = 0.62 * rgb
    x = np.clip(x * (1 + x / 4) / (1 + 0.55 * x), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def take_photo(camera: Camera, solids: list[Solid]) -> Array:
    """Render a photo: sRGB (H, W, 3) in [0, 1].

    There are two rays per pixel and axis. A pixel is a weighted mean over four rays per axis.
    """
    xs, ys = ((np.arange(-1, 2 * n + 1) + 0.5) / 2 for n in (camera.width, camera.height))
    fine: Array = np.empty((len(ys), len(xs), 3))
    for top in range(0, len(ys), TILE):
        for left in range(0, len(xs), TILE):
            tile = np.s_[top : top + TILE, left : left + TILE]
            y, x = np.meshgrid(ys[tile[0]], xs[tile[1]], indexing="ij")
            rgb = radiance(camera.position, camera_rays(camera, x.ravel(), y.ravel()), solids)
            fine[tile] = rgb.T.reshape(*x.shape, 3)
    for _ in range(2):
        a, b, c, d = (fine[k : len(fine) - 3 + k : 2] for k in range(4))
        fine = ((a + d + 3 * (b + c)) / 8).swapaxes(0, 1)
    return expose(fine)


def make_photos(folder: Path, count: int = 30, width: int = 480, height: int = 360, seed: int = 0) -> list[Camera]:
    """Write photos of the still life, ``000.jpg`` and so on.

    Parameters
    ----------
    folder : Path
        Created if it does not exist. Files of the same names are replaced.
    count : int
        Number of photos.
    width, height : int
        Size of a photo, px.
    seed : int
        Seed of the cameras' positions and of the sensor's noise. The scene is always the same.

    Returns
    -------
    list of Camera
        The true cameras in the order of the photos, in metres.

    Raises
    ------
    InputError
        If the number or the size of the photos is less than 1, if the seed is negative, or if a file cannot be
        written.
    """
    from PIL import ExifTags, Image

    if min(count, width, height) < 1:
        raise InputError(f"count, width, height: expected at least 1 each, found {count}, {width}, {height}")
    if seed < 0:
        raise InputError(f"seed: expected 0 or more, found {seed}")
    folder.mkdir(parents=True, exist_ok=True)
    cameras = viewpoints(count, width, height, np.random.default_rng(seed))
    solids = still_life()
    bake(solids)
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = FOCAL_35MM

    def write(k: int) -> None:
        rng = np.random.default_rng([seed, k])
        photo = take_photo(cameras[k], solids) + rng.normal(0, SENSOR_NOISE, (height, width, 3))
        pixels = np.rint(255 * photo.clip(0, 1)).astype(np.uint8)
        with replacing(folder / f"{k:03}.jpg") as file:
            Image.fromarray(pixels).save(file, "jpeg", quality=95, subsampling="4:4:4", exif=exif)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(write, range(count)))
    return cameras


def known_scene(count: int = 24, width: int = 160, height: int = 120, points: int = 2000, seed: int = 0) -> Scene:
    """The still life with its true cameras and points, without files, structure from motion or sensor noise.

    It is meant for experiments that take seconds: the light is gathered from fewer directions than in `make_photos`.

    Parameters
    ----------
    count : int
        Number of photos. Every eighth is held out.
    width, height : int
        Size of a photo, px.
    points : int
        Number of random rays from the training photos. Each ray that hits a surface yields a point.
    seed : int
        Seed of the cameras' positions and of the points.

    Returns
    -------
    Scene
        In metres, z up.

    Raises
    ------
    InputError
        If `count` is less than 2, or another number less than 1.
    """
    if count < 2 or min(width, height, points) < 1:
        found = f"found {count}, {width}, {height}, {points}"
        raise InputError(f"count, width, height, points: expected at least 2, 1, 1 and 1, {found}")
    cameras = viewpoints(count, width, height, np.random.default_rng(seed))
    solids = still_life()
    bake(solids, sun_rays=3, sky_rays=12)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        photos = pool.map(partial(take_photo, solids=solids), cameras)
        views = [
            View(f"{k:03}.png", camera, np.rint(255 * photo).astype(np.uint8))
            for k, (camera, photo) in enumerate(zip(cameras, photos, strict=True))
        ]
    train = [view for k, view in enumerate(views) if k % 8]
    each = np.diff(np.arange(len(train) + 1) * points // len(train))
    parts = [_points(view, n, [seed, k], solids) for k, (view, n) in enumerate(zip(train, each, strict=True))]
    places, colors = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Scene(train, views[::8], places, colors)


def _points(view: View, count: int, seed: list[int], solids: list[Solid]) -> tuple[Array, Array]:
    """Points (P, 3) where `count` random rays of a photo hit a surface, and their colours (P, 3), uint8."""
    camera, rng = view.camera, np.random.default_rng(seed)
    x, y = rng.uniform(0, [[camera.width], [camera.height]], (2, count))
    rays = camera_rays(camera, x, y)
    t, _ = trace(camera.position[:, None], rays, solids)
    seen = np.isfinite(t)
    return (camera.position[:, None] + t * rays).T[seen], view.image[y.astype(int), x.astype(int)][seen]
