"""Experiment: dark areas of photos become transparent."""

from dataclasses import replace

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.bench.stability.small import CONFIG, small_scene, soot
from clsplat.bench.stability.trained import trained
from clsplat.config import DataConfig
from clsplat.device import Device
from clsplat.render import render

SOLID = 25
"""Visibility of the background, of 255, below which a pixel belongs to the object."""


def _dark_areas(device: Device) -> Found:
    scene, figures = soot(small_scene(device), device), []
    for label, random in (("black background", False), ("--random-background", True)):
        gaussians = trained(scene, replace(CONFIG, data=DataConfig(random_background=random)), device)
        alphas = []
        for view in scene.test:
            assert view.clear is not None
            alphas.append(float(render(gaussians, view.camera, device=device).alpha[view.clear < SOLID].mean()))
        figures.append(Figure(label, float(np.mean(alphas))))
    return Found(figures)


DARK_AREAS = Experiment(
    failure="dark areas turning transparent",
    source="Brush #250",
    remedy="a new random background color in each iteration, for transparent photos too (`--random-background`)",
    test="tests/stability/test_dark_areas.py::test_black_objects_stay_opaque",
    measure=_dark_areas,
    figure="mean alpha inside a black object, held-out views",
)
