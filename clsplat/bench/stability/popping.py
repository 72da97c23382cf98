"""Experiment: Gaussians that intersect pop when the camera moves."""

from dataclasses import replace

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found, Plot
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.render import render_views
from clsplat.testing import synthetic_scene

FRAMES = 200
"""Number of frames of a path."""

STEP = 5e-4
"""Step from one frame to the next, radians or fractions of the distance to the scene. It is a twelfth of a pixel."""


def crossing_discs(n: int) -> Gaussians:
    """Discs that intersect each other, so that the order of their centres is not the order along most rays."""
    gaussians = synthetic_scene(n, sh_degree=0)[0]
    rng = np.random.default_rng(0)
    gaussians.means[:] = rng.uniform(-1, 1, (n, 3))
    gaussians.log_scales[:] = np.log([0.5, 0.25, 0.02])
    gaussians.logit_opacities[:] = 3
    gaussians.sh[:, 0] = rng.uniform(-1.7, 1.7, (n, 3))
    return gaussians.astype(np.float32)


def frames(path: str, count: int, step: float, width: int = 160) -> list[Camera]:
    """Cameras at a distance of 4 from the origin that `turn` in place or `move` sideways."""
    distance, height = 4, width * 3 // 4
    cameras = []
    for at in step * (np.arange(count) - count / 2):
        camera = Camera.look_at((0, 0, -distance), (0, 0, 0), (0, -1, 0), width, width, height)
        if path == "move":
            camera = Camera.look_at((distance * at, 0, -distance), (0, 0, 0), (0, -1, 0), width, width, height)
        else:
            turn = np.eye(4)
            turn[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(at), np.sin(at), -np.sin(at), np.cos(at)
            camera = replace(camera, viewmat=turn @ camera.viewmat)
        cameras.append(camera)
    return cameras


def frame_differences(
    device: Device | None, gaussians: Gaussians, cameras: list[Camera], config: RenderConfig
) -> np.ndarray:
    """Mean absolute difference of the colours between each frame and the next, (frames - 1,)."""
    images = (r.rgb for r in render_views(gaussians, cameras, config, device))
    before, differences = next(images), []
    for image in images:
        differences.append(float(np.abs(image - before).mean()))
        before = image
    return np.array(differences)


def _popping(device: Device) -> Found:
    gaussians = crossing_discs(60)
    figures: list[Figure] = []
    series: dict[str, list[tuple[float, float | None]]] = {}
    for label, config in (("sorted by centre", RenderConfig()), ("sorted by pixel", RenderConfig(sort="pixel"))):
        worst = []
        for path in ("turn", "move"):
            found = frame_differences(device, gaussians, frames(path, FRAMES, STEP), config)
            worst.append(found.max() / np.median(found))
            if path == "move":
                series[label] = [(float(i), float(v)) for i, v in enumerate(found)]
        figures += [Figure(f"{label}, camera turns", worst[0]), Figure(f"{label}, camera moves", worst[1])]
    # The worse of the two paths, first without the remedy.
    plain, sorted_ = max(figures[:2], key=lambda f: f.value), max(figures[2:], key=lambda f: f.value)
    return Found([plain, sorted_], Plot("frame", "mean difference from the frame before", series))


POPPING = Experiment(
    failure="popping when the camera turns or moves",
    source="StopThePop, Radl et al. 2024",
    remedy="each pixel sorts its Gaussians by depth along its ray (`--sort pixel`)",
    test="tests/stability/test_popping.py::test_nothing_pops",
    measure=_popping,
    figure="largest difference between two frames, in multiples of the median; 60 discs that intersect",
)
