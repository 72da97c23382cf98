"""Photos of known Gaussians from a ring of cameras, small enough to train on in a second."""

from dataclasses import replace

import numpy as np

from clsplat.camera import Camera
from clsplat.config import AdcConfig, InitConfig, OptimConfig, TrainConfig
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene

SIZE = (40, 32)

CONFIG = TrainConfig(
    iterations=300,
    eval_every=0,
    checkpoint_every=100,
    max_gaussians=80,
    init=InitConfig(sh_degree=1),
    # Points are 0.05 off, 600 times the default step.
    optim=OptimConfig(means_lr=1.6e-3, means_lr_final=1e-4, sh_degree_every=2333),
    adc=AdcConfig(every=50, reset_every=1000, grad_threshold=1e-5),
)


def small_scene(device, photos: int = 12, held_out: int = 3) -> Scene:
    """Training photos all around, held-out ones between them."""
    rng = np.random.default_rng(0)
    truth = synthetic_scene(40, seed=4)[0]
    truth.means[:] = rng.uniform(-0.6, 0.6, truth.means.shape)
    truth.log_scales[:] = np.log(0.15)
    truth.logit_opacities[:] = 1.5
    truth.sh[:, 0] = rng.uniform(-1, 1.5, (40, 3))
    truth.sh[:, 4:] = 0
    truth = truth.astype(np.float32)

    def views(angles, name):
        for i, a in enumerate(angles):
            position = [3 * np.sin(a), -1 + 0.3 * np.sin(3 * a), 3 * np.cos(a)]
            camera = Camera.look_at(position, [0, 0, 0], [0, -1, 0], 45, *SIZE)
            yield View(f"{name}{i:02}.png", camera, to_uint8(render(truth, camera, device=device).rgb))

    step = 2 * np.pi / photos
    train = list(views(np.arange(photos) * step, "train"))
    test = list(views((np.arange(held_out) * (photos // held_out) + 0.5) * step, "test"))
    points = truth.means + rng.normal(0, 0.05, truth.means.shape)
    return Scene(train, test, points.astype(np.float64), np.full(points.shape, 128, np.uint8))


def with_train(scene: Scene, change) -> Scene:
    """The scene with other training photos: `change` of each, and of a generator of random numbers."""
    rng = np.random.default_rng(0)
    return replace(scene, train=[change(view, rng) for view in scene.train])
