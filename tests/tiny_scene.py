"""A scene to train on in a moment: Gaussians seen from three sides."""

import numpy as np

from clsplat.camera import Camera
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene


def tiny_scene(count: int = 3) -> Scene:
    """Photos of 20 Gaussians, rendered by the twins, and points near them."""
    truth = synthetic_scene(20, seed=4)[0]
    rng = np.random.default_rng(0)
    truth.means[:] = rng.uniform(-0.6, 0.6, truth.means.shape)
    truth.log_scales[:] = np.log(0.15)
    truth.logit_opacities[:] = 1.5
    views = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        camera = Camera.look_at([3 * np.sin(angle), -1, 3 * np.cos(angle)], [0, 0, 0], [0, -1, 0], 20, 20, 16)
        views.append(View(f"{i}.png", camera, to_uint8(render(truth, camera, device="reference").rgb)))
    points = truth.means.astype(np.float64)
    return Scene(views, [], points, np.full(points.shape, 128, np.uint8))
