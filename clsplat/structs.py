"""NumPy dtypes of the structs that kernels take by value. cl/structs.h holds their OpenCL counterparts."""

from functools import cache, lru_cache
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.stages import ERANK_SLACK, AdamStep

PENALTIES = ("opacity_penalty", "scale_penalty", "erank_penalty")
RATES = ("means", "log_scales", "quats", "logit_opacities", "sh0", "sh_rest")


ADAM = (*RATES, "keep1", "take1", "keep2", "take2", "inv_correction2", "eps", *PENALTIES, "erank_slack")

CAMERAS = 1024
"""Number of cameras whose structs are kept. A step of training takes the same one twice, and again in each epoch."""


@cache
def _camera_type(real: Any) -> np.dtype[Any]:
    return np.dtype(
        [
            ("rotation", real, 9),
            ("translation", real, 3),
            ("position", real, 3),
            ("intrinsics", real, 4),
            ("distortion", real, 4),
            ("cos_max", real),
            ("near", real),
            ("size", "i4", 2),
        ]
    )


@cache
def _adam_type(real: Any) -> np.dtype[Any]:
    return np.dtype([(name, real) for name in ADAM])


@lru_cache(CAMERAS)
def camera_struct(camera: Camera, real: Any) -> np.ndarray:
    """The struct `Camera` of cl/structs.h, for a build with reals of the type `real` (float32 or float64)."""
    struct = np.zeros((), dtype=_camera_type(real))
    struct["rotation"] = camera.viewmat[:3, :3].ravel()
    struct["translation"] = camera.viewmat[:3, 3]
    struct["position"] = camera.position
    struct["intrinsics"] = camera.fx, camera.fy, camera.cx, camera.cy
    if camera.model == "fisheye":
        struct["distortion"], struct["cos_max"] = camera.distortion, np.cos(camera.angle_max)
    struct["near"] = camera.near_depth
    struct["size"] = camera.width, camera.height
    return struct


def lens_define(camera: Camera, rays: bool = False) -> str:
    """Value of -DLENS (cl/lens.h) for a camera, and whether Gaussians are evaluated along its rays.

    Raises
    ------
    InputError
        If the camera is equirectangular, and has no affine approximation; or orthographic with `rays`.
    """
    if camera.model == "equirectangular" and not rays:
        raise InputError(
            "camera: expected a pinhole, orthographic or fisheye camera, found an equirectangular one; "
            "`render` draws such panoramas, and --projection ray projects to them"
        )
    if camera.model == "orthographic" and rays:
        raise InputError("camera: expected a perspective one for rays=True, found an orthographic one")
    return camera.model.upper()


def adam_struct(step: AdamStep, real: Any) -> np.ndarray:
    """The struct `Adam` of cl/structs.h. The differences 1 - beta and the corrections are computed in float64."""
    correction1, correction2 = 1 - step.beta1**step.iteration, 1 - step.beta2**step.iteration
    rates = [step.rates[name] / correction1 for name in RATES]
    betas = [step.beta1, 1 - step.beta1, step.beta2, 1 - step.beta2]
    values = (*rates, *betas, 1 / correction2, step.eps, *step.penalties, ERANK_SLACK)
    return np.array(values, dtype=_adam_type(real))
