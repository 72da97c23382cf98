"""A scene of small photos of known Gaussians, from a ring of cameras. A training on it takes about a second."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from clsplat.camera import Camera
from clsplat.config import AdcConfig, CoarseConfig, InitConfig, TrainConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene
from clsplat.training.presets import load_preset

SIZE = (40, 32)
"""Width and height of the photos, px."""

CONFIG = TrainConfig(
    strategy="adc",
    size="fixed",
    iterations=300,
    eval_every=0,
    checkpoint_every=100,
    max_gaussians=80,
    init=InitConfig(sh_degree=1),
    # The original's rates, except for the means: the points are off by 0.05, which is 600 times the original's step.
    optim=replace(load_preset("paper-7k").optim, means_lr=1.6e-3, means_lr_final=1e-4, sh_degree_every=2333),
    coarse=CoarseConfig(factor=1),
    adc=AdcConfig(every=50, reset_every=1000, grad_threshold=1e-5),
)


def known_gaussians() -> Gaussians:
    """The Gaussians that the photos show: 40 balls with random colours."""
    rng = np.random.default_rng(0)
    truth = synthetic_scene(40, seed=4)[0]
    truth.means[:] = rng.uniform(-0.6, 0.6, truth.means.shape)
    truth.log_scales[:] = np.log(0.15)
    truth.logit_opacities[:] = 1.5
    truth.sh[:, 0] = rng.uniform(-1, 1.5, (40, 3))
    truth.sh[:, 4:] = 0
    return truth.astype(np.float32)


def small_scene(device: Device, photos: int = 12, held_out: int = 3) -> Scene:
    """Training photos in a circle, held-out photos between them, and a point near each Gaussian."""
    truth = known_gaussians()

    def views(angles: np.ndarray, name: str) -> list[View]:
        positions = [[3 * np.sin(a), -1 + 0.3 * np.sin(3 * a), 3 * np.cos(a)] for a in angles]
        cameras = [Camera.look_at(position, [0, 0, 0], [0, -1, 0], 45, *SIZE) for position in positions]
        return [
            View(f"{name}{i:02}.png", camera, to_uint8(render(truth, camera, device=device).rgb))
            for i, camera in enumerate(cameras)
        ]

    step = 2 * np.pi / photos
    train = views(np.arange(photos) * step, "train")
    test = views((np.arange(held_out) * (photos // held_out) + 0.5) * step, "test")
    points = truth.means + np.random.default_rng(1).normal(0, 0.05, truth.means.shape)
    return Scene(train, test, points.astype(np.float64), np.full(points.shape, 128, np.uint8))


def with_train(scene: Scene, change: Callable[[View, np.random.Generator], View]) -> Scene:
    """Replace each training photo by `change` of it and of a generator of random numbers."""
    rng = np.random.default_rng(0)
    return replace(scene, train=[change(view, rng) for view in scene.train])


def soot(scene: Scene, device: Device) -> Scene:
    """Replace all photos by a black object on a transparent background."""
    truth = known_gaussians()

    def cut_out(view: View) -> View:
        covered = render(truth, view.camera, device=device).alpha
        clear = np.rint(255 * (1 - covered)).astype(np.uint8)
        return replace(view, image=np.zeros_like(view.image), clear=clear)

    return replace(scene, train=[cut_out(v) for v in scene.train], test=[cut_out(v) for v in scene.test])
