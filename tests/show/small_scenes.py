"""A small scene with cameras around it, and a training on it that takes a second."""

import math

import numpy as np

from clsplat.camera import Camera
from clsplat.config import TrainConfig
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene
from clsplat.training.loop import train

SIZE = (320, 240)


def cameras(count=5, tilt=0.2):
    """Gaussians of `synthetic_scene`, and cameras around them, tilted to alternating sides."""
    gaussians, camera = synthetic_scene(300, seed=5)
    centre = gaussians.means.mean(axis=0)
    distance = np.linalg.norm(camera.position - centre)
    result = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        eye = centre + distance * np.array([math.sin(angle), 0.3 * math.sin(2 * i), -math.cos(angle)])
        up = (tilt * (-1) ** i, -1, 0.1 * i)
        result.append(Camera.look_at(eye, centre, up, 300 + 10 * i, *SIZE))
    return gaussians, result


def views_of(cams):
    return [View(f"{i}.png", c, np.zeros((c.height, c.width, 3), np.uint8)) for i, c in enumerate(cams)]


def small_training(device, out, progress=lambda record: None, **options):
    gaussians, cams = cameras()
    photos = [View(f"{i}.png", c, to_uint8(render(gaussians, c, device=device).rgb)) for i, c in enumerate(cams)]
    points = gaussians.means[:100].astype(np.float64)
    scene = Scene(photos, [], points, np.full((100, 3), 128, np.uint8))
    fixed = {"strategy": "adc", "size": "fixed", "iterations": 12, "max_gaussians": 150, "eval_every": 0}
    config = TrainConfig(**fixed | options)
    return train(scene, config, out, device, progress=progress)
