"""Experiment: a scene far from the origin of the world."""

from dataclasses import replace

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found, Plot
from clsplat.device import Device
from clsplat.render import render
from clsplat.testing import synthetic_scene

OFFSETS = 10.0 ** np.arange(0, 8)
"""Offsets along each axis, world units. The scene measures 3 units. UTM coordinates reach 5e6."""

FLOOR = 2.0**-24
"""Smallest difference on the logarithmic chart: half a step of float32 below 1. Equal images are shown here."""


def _world_offset(device: Device) -> Found:
    gaussians, camera = synthetic_scene(2000, width=160, height=120)
    here = render(gaussians.astype(np.float32), camera, device=device, gradients=False).rgb
    series: dict[str, list[tuple[float, float | None]]] = {"float32 in the world": [], "origin moved in float64": []}
    for distance in OFFSETS:
        offset = np.array([distance, -distance, distance])
        far, moved = replace(gaussians, means=gaussians.means + offset), camera.translated(-offset)
        near = replace(far, means=far.means - offset)
        for label, scene, view in (
            ("float32 in the world", far, moved),
            ("origin moved in float64", near, moved.translated(offset)),
        ):
            rgb = render(scene.astype(np.float32), view, device=device, gradients=False).rgb
            series[label].append((float(distance), max(float(np.abs(rgb - here).max()), FLOOR)))
    return Found(
        [Figure(label, dict(points)[1e6] or 0.0) for label, points in series.items()],
        Plot(
            "distance of the scene from the origin, world units",
            "largest difference of a colour (0 as 6e-8)",
            series,
            "xy",
        ),
    )


WORLD_OFFSET = Experiment(
    failure="geo-referenced coordinates",
    source="float32 at 5e6 has steps of 0.5",
    remedy="the origin is moved to the cameras in float64 when a dataset is loaded, and back at export",
    test="tests/stability/test_coordinates.py::test_the_same_image_in_coordinates_of_the_world",
    measure=_world_offset,
    figure="largest difference of a colour (of 0 to 1), world shifted by 1e6",
)
