"""Equirectangular panoramas as the six faces of a cube: pinhole views that are rendered and trained on."""

from functools import lru_cache
from math import ceil, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera

FACES = {
    "front": np.diag([1.0, 1.0, 1.0]),
    "right": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "back": np.diag([-1.0, 1.0, -1.0]),
    "left": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "down": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Rotations from the panorama's frame (x right, y down, z forward) to each face's; the last row is where it looks."""

BORDER = 2
"""Pixels that a rendered face has beyond its 90 degrees, for interpolation between the last ones."""


def face_size(camera: Camera) -> int:
    """Edge in pixels of a face of 90 degrees that has in its middle the panorama's pixels per angle."""
    return ceil(2 * max(camera.fx, camera.fy))


def rotated(viewmat: NDArray[np.float64], face: str) -> NDArray[np.float64]:
    """viewmat (4, 4) of a face of the panorama whose viewmat is given."""
    result = viewmat.copy()
    result[:3] = FACES[face] @ viewmat[:3]
    return result


def faces(camera: Camera) -> list[Camera]:
    """Pinhole cameras that see together what an equirectangular camera sees, in the order of FACES."""
    size = face_size(camera) + 2 * BORDER
    focal, centre = face_size(camera) / 2, size / 2
    return [Camera(rotated(camera.viewmat, face), focal, focal, centre, centre, size, size) for face in FACES]


def assemble(camera: Camera, images: list[NDArray[np.floating]]) -> NDArray[np.floating]:
    """The panorama (H, W, C) from images (S, S, C) of its `faces`, by bilinear interpolation."""
    from scipy.ndimage import map_coordinates

    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays(u, v)
    towards = np.stack([rays @ rotation[2] for rotation in FACES.values()])
    nearest = towards.argmax(axis=0)
    result = np.empty((camera.height, camera.width, images[0].shape[2]), images[0].dtype)
    for k, (image, rotation) in enumerate(zip(images, FACES.values(), strict=True)):
        here = nearest == k
        x, y, z = rotation @ rays[here].T
        # Indices count from pixel centres.
        places = image.shape[0] / 2 - 0.5 + face_size(camera) / 2 * np.stack([y / z, x / z])
        for channel in range(image.shape[2]):
            result[here, channel] = map_coordinates(image[:, :, channel], places, order=1, mode="nearest")
    return result


@lru_cache(maxsize=len(FACES))
def face_positions(face: str, width: int, height: int, size: int) -> NDArray[np.float32]:
    """Row and column indices, (2, S, S), at which the pixels of a face lie in a panorama of `width` x `height` px."""
    panorama = Camera(
        np.eye(4), width / (2 * pi), height / pi, width / 2, height / 2, width, height, "equirectangular"
    )
    pinhole = Camera(np.eye(4), size / 2, size / 2, size / 2, size / 2, size, size)
    u, v = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    x, y, z = np.moveaxis(pinhole.rays(u, v) @ FACES[face], -1, 0)
    columns = panorama.fx * np.arctan2(x, z) + panorama.cx
    rows = panorama.fy * np.arctan2(y, np.hypot(x, z)) + panorama.cy
    return np.stack([rows, columns]).astype(np.float32) - np.float32(0.5)


def bordered(pixels: NDArray[Any]) -> NDArray[Any]:
    """A panorama (H, W, ...) with a pixel more on each side: beyond a pole the opposite ones, and across the seam."""
    half = pixels.shape[1] // 2
    tall = np.concatenate([np.roll(pixels[:1], half, axis=1), pixels, np.roll(pixels[-1:], half, axis=1)])
    return np.concatenate([tall[:, -1:], tall, tall[:, :1]], axis=1)
