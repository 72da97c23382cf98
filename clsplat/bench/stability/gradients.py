"""Experiment: gradients that do not match the image."""

import numpy as np

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.camera import Camera
from clsplat.constants import ALPHA_MAX
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.render import render
from clsplat.testing import synthetic_scene

OTHER_ALPHA_MAX = 0.999
"""Largest alpha of OpenSplat's forward pass. That of its backward pass is 0.99."""

STEP = 1e-6
"""Step of central differences in float64. Their error is about the square of the step."""


def saturated(n: int = 30) -> tuple[Gaussians, Camera]:
    """Large Gaussians with opacities around ALPHA_MAX, so that alpha is clamped in many pixels."""
    gaussians, camera = synthetic_scene(n, seed=2)
    gaussians.logit_opacities[:] = np.linspace(4, 6, n)  # 0.982 to 0.998
    gaussians.log_scales += 1
    return gaussians, camera


def mismatch(forward: Device, backward: Device) -> float:
    """Relative error of one device's derivatives by the opacities, compared with differences of another's images."""
    gaussians, camera = saturated()
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(camera.height, camera.width, 3))
    found = render(gaussians, camera, device=backward).backward(weights).gaussians.logit_opacities
    expected = np.zeros_like(found)
    for i in range(len(gaussians)):
        for sign in (1, -1):
            moved = gaussians.astype(np.float64)
            moved.logit_opacities[i] += sign * STEP
            image = render(moved, camera, device=forward, gradients=False).rgb
            expected[i] += sign * float((image * weights).sum()) / (2 * STEP)
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def _constants(device: Device) -> Found:
    ours = Device(device.cl_device, real=np.float64)
    other = Device(device.cl_device, real=np.float64, model={"ALPHA_MAX": OTHER_ALPHA_MAX})
    return Found(
        [
            Figure(
                f"clamped at {OTHER_ALPHA_MAX} forward, at {ALPHA_MAX} backward", 100 * mismatch(other, ours), "%"
            ),
            Figure(f"at {ALPHA_MAX} in both", 100 * mismatch(ours, ours), "%"),
        ]
    )


CONSTANTS = Experiment(
    failure="forward/backward constants differ, saturated alpha",
    source="OpenSplat: 0.999 and 0.99",
    remedy="one module of constants feeds all kernels; the gradient is 0 where alpha is clamped",
    test="tests/stability/test_gradients.py::test_gradients_are_those_of_the_image_where_alpha_saturates",
    measure=_constants,
    figure="relative error of the derivatives by the opacity of opaque Gaussians, from differences of images",
)
