"""Photos of a textured corner, for structure from motion."""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from clsplat.camera import Camera
from clsplat.config import SfmConfig

CONFIG = SfmConfig(camera_model="SIMPLE_RADIAL")


def cameras():
    """Four cameras in front of a corner, about 11 degrees apart."""
    eyes = [(3.2 * np.cos(a), 3.2 * np.sin(a), 1.6 + 0.3 * (k % 2)) for k, a in enumerate(np.linspace(0.5, 1.1, 4))]
    return [Camera.look_at(eye, (0.4, 0.4, 0.4), (0, 0, 1), 300, 320, 240) for eye in eyes]


def corner(camera, textures):
    """Photo of the three planes x = 0, y = 0, z = 0, with 160 texture pixels per unit; black beyond."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = camera.rays(x, y) @ camera.viewmat[:3, :3]
    reach = np.where(rays < 0, -camera.position / rays, np.inf)
    plane, hit = reach.argmin(axis=-1), camera.position + rays * reach.min(axis=-1)[..., None]
    photo = np.zeros((*x.shape, 3))
    for axis in range(3):
        on = (plane == axis) & np.isfinite(hit).all(axis=-1)
        at = 160 * np.delete(hit[on], axis, axis=1).T
        for channel in range(3):
            photo[on, channel] = map_coordinates(textures[axis][..., channel], at, order=1, mode="grid-wrap")
    return np.rint(photo).astype(np.uint8)


def take_photos(seed, seen_by=None):
    """Render a corner with textures of its own from the four cameras, or from others."""
    rng = np.random.default_rng(seed)
    textures = []
    for _ in range(3):
        layers = [s * gaussian_filter(rng.normal(size=(512, 512, 3)), (s, s, 0), mode="wrap") for s in (1.5, 4, 12)]
        textures.append(np.clip(127 + 60 * sum(layers) / np.std(sum(layers)), 0, 255))
    return [corner(camera, textures) for camera in seen_by or cameras()]
