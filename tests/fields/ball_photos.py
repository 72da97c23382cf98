"""Photos of a ball whose colour depends on the place, exact to the pixel, with transparency or in a round room."""

import numpy as np

from clsplat.camera import Camera
from clsplat.scene import Scene, View

RADIUS, DISTANCE, EDGE, WALL = 0.7, 4.0, 24, 12.0


def photo(position, background=(1.0, 1.0, 1.0), name="photo", edge=EDGE, room=False):
    """A view of the ball around the origin, on a background, or in front of the wall of a room that is a sphere."""
    camera = Camera.look_at(position, (0, 0, 0), (0, 0, 1), 2.2 * edge, edge, edge)
    v, u = np.divmod(np.arange(edge * edge), edge)
    directions = camera.rays(u + 0.5, v + 0.5) @ camera.viewmat[:3, :3]
    along = -directions @ camera.position
    square = along**2 - (camera.position @ camera.position - RADIUS**2)
    hit = square > 0
    points = camera.position + (along - np.sqrt(np.where(hit, square, 0)))[:, None] * directions
    if room:
        far = along + np.sqrt(along**2 - (camera.position @ camera.position - WALL**2))
        background = 0.5 + 0.5 * np.cos(2 * (camera.position + far[:, None] * directions) / WALL)
    colors = np.where(hit[:, None], 0.5 + 0.5 * np.sin(1.5 * points / RADIUS), background)
    image = np.rint(255 * colors).astype(np.uint8).reshape(edge, edge, 3)
    clear = np.where(hit, 0, 255).astype(np.uint8).reshape(edge, edge)
    return View(name, camera, image, clear=None if room else clear)


def ball(photos=45, held_out=3, **options):
    """A scene of the ball, seen from all around."""
    n = photos + held_out
    z = np.linspace(-0.8, 0.8, n)
    angle = np.arange(n) * 2.4
    radius = np.sqrt(1 - z**2)
    positions = DISTANCE * np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    views = [photo(p, name=f"{k:02d}.png", **options) for k, p in enumerate(positions)]
    every = n // held_out
    test = views[every // 2 :: every][:held_out]
    return Scene([v for v in views if v not in test], test, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
