"""Experiments: cameras with a wrong focal length, and an object that moves while the photos are taken."""

from dataclasses import replace
from tempfile import TemporaryDirectory

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.small import CONFIG, small_scene, with_train
from clsplat.config import TrainConfig
from clsplat.device import Device
from clsplat.evaluate import mean_metrics
from clsplat.renderer import Renderer
from clsplat.scene import Scene, View
from clsplat.training.loop import train

FOCAL_ERROR = 1.3
"""Factor by which the focal length is wrong, that of a phone's wide lens taken for its main one."""

MOVING_EVERY = 3
"""Every third photo shows the object that moves."""


def wrong_focal(scene: Scene, factor: float = FOCAL_ERROR) -> Scene:
    """Multiply the focal lengths of the training photos."""
    return with_train(
        scene,
        lambda view, _: replace(
            view, camera=replace(view.camera, fx=view.camera.fx * factor, fy=view.camera.fy * factor)
        ),
    )


def moving_object(scene: Scene, *, masked: bool = False) -> Scene:
    """Put a red square into every third training photo, each time elsewhere; masked, its pixels do not count."""
    views = list(scene.train)
    rng = np.random.default_rng(0)
    for i in range(0, len(views), MOVING_EVERY):
        image = views[i].image.copy()
        height, width = image.shape[:2]
        edge = height // 3
        top, left = rng.integers(0, height - edge), rng.integers(0, width - edge)
        image[top : top + edge, left : left + edge] = (230, 20, 20)
        mask = np.ones((height, width), bool)
        mask[top : top + edge, left : left + edge] = False
        views[i] = replace(views[i], image=image, mask=mask if masked else None)
    return replace(scene, train=views)


def held_out_psnr(scene: Scene, test: list[View], device: Device, config: TrainConfig = CONFIG) -> float:
    """PSNR of photos with right cameras and without the object, after a training on a scene, dB."""
    with TemporaryDirectory() as folder:
        gaussians = train(scene, config, folder, device)
    return float(mean_metrics(gaussians, test, Renderer(device))["psnr"])


def _focal(device: Device) -> Found:
    scene = small_scene(device)
    scenes = {"30 % too long": wrong_focal(scene), "30 % too short": wrong_focal(scene, 0.7), "right": scene}
    return Found([Figure(label, held_out_psnr(s, scene.test, device), "dB") for label, s in scenes.items()])


def _moving(device: Device) -> Found:
    scene = small_scene(device)
    scenes = {
        "object in a third of the photos": moving_object(scene),
        "masked": moving_object(scene, masked=True),
        "no object": scene,
    }
    return Found([Figure(label, held_out_psnr(s, scene.test, device), "dB") for label, s in scenes.items()])


FOCAL_LENGTH = Experiment(
    failure="focal length wrong by 30 %",
    source="phones with several lenses; cropped photos",
    remedy=None,
    test="tests/stability/test_hard_photos.py::test_a_wrong_focal_length_costs_quality",
    measure=_focal,
    figure="PSNR of held-out photos with the right focal length",
)

MOVING = Experiment(
    failure="an object that moves",
    source="Sabour et al. 2023",
    remedy="masks (`--masks`)",
    test="tests/stability/test_hard_photos.py::test_masks_remove_an_object_that_moves",
    measure=_moving,
    figure="PSNR of held-out photos without the object",
)
