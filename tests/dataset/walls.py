"""Photos of a wall whose parts in view are known by hand."""

import numpy as np

from clsplat.camera import Camera
from clsplat.scene import Scene, View

WIDTH, HEIGHT = 70, 40
WALL = 4.0


def view(name, x=0.0, z=0.0, **camera):
    """A photo from (x, 0, z), looking along z at a wall in the plane z = WALL."""
    viewmat = np.eye(4)
    viewmat[[0, 2], 3] = -x, -z
    made = Camera(viewmat, 50, 50, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, **camera)
    return View(name, made, np.zeros((HEIGHT, WIDTH, 3), np.uint8))


def wall(spacing=0.1):
    x, y = np.meshgrid(np.arange(-8, 8, spacing), np.arange(-4, 4, spacing))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, WALL)], axis=1)


def scene_of(train, test, points=None):
    points = wall() if points is None else points
    return Scene(train, test, points, np.arange(3 * len(points)).reshape(-1, 3).astype(np.uint8))
