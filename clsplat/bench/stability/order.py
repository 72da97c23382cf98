"""Experiments on order: Gaussians of equal depths, and sums in different orders."""

from dataclasses import replace

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.render import render
from clsplat.testing import synthetic_scene

RUNS = 5
"""Number of repeated runs."""


def _wall(n: int) -> tuple[Gaussians, Camera]:
    """Gaussians of many colours that all have the same depth."""
    gaussians, camera = synthetic_scene(n, width=160, height=120)
    flat = gaussians.means @ camera.viewmat[:3, :3].T
    flat[:, 2] = 0
    # The camera looks along z from a distance of 4, so that all depths are exactly 4 in any precision.
    viewmat = np.eye(4)
    viewmat[2, 3] = 4
    return replace(gaussians, means=flat), replace(camera, viewmat=viewmat)


def _equal_depths(device: Device) -> Found:
    gaussians, camera = _wall(2000)
    wall = gaussians.astype(np.float32)
    first = render(wall, camera, device=device, gradients=False).rgb
    again = [render(wall, camera, device=device, gradients=False).rgb for _ in range(RUNS)]
    # If scheduling decides the order of ties, any permutation of them may occur.
    rng = np.random.default_rng(0)
    shuffled = [
        render(wall.take(rng.permutation(len(wall))), camera, device=device, gradients=False).rgb for _ in range(RUNS)
    ]
    return Found(
        [
            Figure("ties in any order", max(float(np.abs(rgb - first).max()) for rgb in shuffled)),
            Figure("ties by index", max(float(np.abs(rgb - first).max()) for rgb in again)),
        ]
    )


def _repeated_runs(device: Device) -> Found:
    gaussians, camera = synthetic_scene(2000, width=160, height=120)
    scene = gaussians.astype(np.float32)

    def gradient() -> np.ndarray:
        rendering = render(scene, camera, device=device)
        return np.asarray(rendering.backward(rendering.rgb).gaussians.means)

    first = gradient()
    differing = sum(int((gradient() != first).sum()) for _ in range(RUNS))
    # Float atomics add the same terms in the order in which work-items happen to arrive.
    terms = np.random.default_rng(0).normal(size=(1000, 256)).astype(np.float32)
    order = np.random.default_rng(1).permutation(256)
    sums = [np.add.accumulate(part, axis=1)[:, -1] for part in (terms, terms[:, order])]
    return Found(
        [
            Figure("256 terms in two orders", 100 * float((sums[0] != sums[1]).mean()), "% of sums differ"),
            Figure("gradients of the same image", 100 * differing / (RUNS * first.size), "% of numbers differ"),
        ]
    )


EQUAL_DEPTHS = Experiment(
    failure="equal depths",
    source="any sort that is not stable",
    remedy="stable sort by depth, ties by index",
    test="tests/stability/test_order.py::test_ties_have_one_order",
    measure=_equal_depths,
    figure="largest difference of a colour (of 0 to 1) between renders of a wall of 2000 Gaussians",
)

REPEATED_RUNS = Experiment(
    failure="runs that differ",
    source="Brush #525: 404k to 897k splats from one seed; INRIA #89: 24.2 to 28.1 dB",
    remedy="sums in a fixed order, no float atomics; random numbers from counters",
    test="tests/stability/test_order.py::test_runs_repeat_to_the_bit",
    measure=_repeated_runs,
    figure="numbers that differ between runs",
)
