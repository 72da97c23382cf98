"""Equirectangular panoramas as six faces of a cube: pinhole views for rendering and training."""

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
"""Rotations from the frame of the panorama (x right, y down, z forward) to that of each face. The last row is the
viewing direction of the face."""

BORDER = 2
"""Border of a rendered face beyond its 90 degrees, px, for interpolation at the edges."""


def face_size(camera: Camera) -> int:
    """Compute the edge, in pixels, of a face of 90 degrees with the panorama's pixels per angle at its centre."""
    return ceil(2 * max(camera.fx, camera.fy))


def rotated(viewmat: NDArray[np.float64], face: str) -> NDArray[np.float64]:
    """Compute the viewmat (4, 4) of a face from that of its panorama."""
    result = viewmat.copy()
    result[:3] = FACES[face] @ viewmat[:3]
    return result


def faces(camera: Camera) -> list[Camera]:
    """Make the pinhole cameras that together cover the view of an equirectangular camera, in the order of FACES."""
    size = face_size(camera) + 2 * BORDER
    focal, centre = face_size(camera) / 2, size / 2
    return [
        Camera(rotated(camera.viewmat, face), focal, focal, centre, centre, size, size, near=camera.near)
        for face in FACES
    ]


def assemble(camera: Camera, images: list[NDArray[np.floating]]) -> NDArray[np.floating]:
    """Assemble a panorama (H, W, C) from images (S, S, C) of its `faces`, by bilinear interpolation."""
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
        positions = image.shape[0] / 2 - 0.5 + face_size(camera) / 2 * np.stack([y / z, x / z])
        for channel in range(image.shape[2]):
            result[here, channel] = map_coordinates(image[:, :, channel], positions, order=1, mode="nearest")
    return result


@lru_cache(maxsize=len(FACES))
def face_positions(face: str, width: int, height: int, size: int) -> NDArray[np.float32]:
    """Compute the row and column indices, (2, S, S), of a face's pixels in a panorama of `width` x `height` px."""
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
    """Extend a panorama (H, W, ...) by a pixel on each side: across the seam, and across the poles."""
    half = pixels.shape[1] // 2
    tall = np.concatenate([np.roll(pixels[:1], half, axis=1), pixels, np.roll(pixels[-1:], half, axis=1)])
    return np.concatenate([tall[:, -1:], tall, tall[:, :1]], axis=1)
