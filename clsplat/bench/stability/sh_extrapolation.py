"""Experiment: colours seen from directions that no photo constrains."""

from dataclasses import replace
from typing import Literal

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.small import CONFIG, small_scene, with_train
from clsplat.bench.stability.trained import held_out, trained
from clsplat.device import Device
from clsplat.scene import Scene, View

Degree = Literal[0, 1, 2, 3]


def one_side(scene: Scene) -> Scene:
    """Keep the training photos of a quarter of the circle, and give each a random brightness.

    The brightness makes the colours depend on the direction of view.
    """

    def lit(view: View, rng: np.random.Generator) -> View:
        return replace(view, image=np.clip(view.image * rng.uniform(0.8, 1.2), 0, 255).astype(np.uint8))

    scene = with_train(scene, lit)
    return replace(scene, train=scene.train[:4], test=scene.test[1:])


def unseen_side(degree: Degree, device: Device) -> float:
    """PSNR, dB, of photos from the unseen side after training with this degree of spherical harmonics."""
    scene = one_side(small_scene(device))
    config = replace(CONFIG, init=replace(CONFIG.init, sh_degree=degree))
    # The training is short: higher bands get the learning rate of band 0, so that they take part in it.
    config = replace(config, optim=replace(config.optim, sh_degree_every=1000, sh_rest_lr=config.optim.sh0_lr))
    return held_out(trained(scene, config, device), scene, config, device)


def _extrapolation(device: Device) -> Found:
    degrees: dict[Degree, str] = {3: "degree 3", 1: "--init.sh-degree 1", 0: "--init.sh-degree 0"}
    return Found([Figure(label, unseen_side(degree, device), "dB") for degree, label in degrees.items()])


EXTRAPOLATION = Experiment(
    failure="SH extrapolation",
    source="bands that no photo constrains",
    remedy="fewer bands (`--init.sh-degree`), where a scene is seen from sides that no photo shows",
    test="tests/stability/test_views.py::test_unseen_sides_keep_their_colour",
    measure=_extrapolation,
    figure="PSNR of photos from the unseen side; trained on 4 photos of a quarter of a circle whose brightness "
    "differs by 20 %, 40x32, higher bands with the learning rate of band 0",
)
