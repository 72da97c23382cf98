"""Refinement of camera poses: a rigid motion for each training photo, optimised together with the scene.

Structure from motion is accurate to a fraction of a pixel at best, and poses from a phone's tracking or a rig are
worse. Gaussians then become blurred. The gradient of the loss with respect to the viewmat shows how to move the
camera (Lin et al. 2021, "BARF"). Scene and cameras can move together without changing the renders. An evaluation of
held-out photos, whose cameras were not refined, therefore aligns each of them with the scene first.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import OptimConfig
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.stages import Image
from clsplat.training.photo_parameters import PerPhoto

Array = NDArray[Any]

ALIGNING_STEPS = 100
"""Steps in which a held-out photo's camera is aligned with a scene; at the default rates they can turn it by 1.2
degrees."""


def start(names: list[str]) -> PerPhoto:
    """Identity motions, (V, 4, 4) for V photos; each is applied in its camera's frame, after the viewmat."""
    return PerPhoto.start(names, np.eye(4), (6,))


def refined(camera: Camera, motion: Array) -> Camera:
    """Apply a motion (4, 4) to a camera, in its own frame."""
    return replace(camera, viewmat=motion @ camera.viewmat)


def update(
    poses: PerPhoto, name: str, camera: Camera, v_viewmat: Array, rate: float, extent: float, config: OptimConfig
) -> None:
    """Take a step on a photo's motion by the gradient (4, 4) with respect to the viewmat of its refined camera.

    rate: learning rate of rotations, radians, and of positions, extents of the scene.
    """
    rates = rate * np.array([1, 1, 1, extent, extent, extent])
    step = poses.step(name, twist_gradient(camera.viewmat, v_viewmat), rates, config)
    poses.of(name)[:] = exponential(step) @ poses.of(name)


def rate_at(progress: float, config: OptimConfig) -> float:
    """Learning rate after a fraction of the training, 0 to 1."""
    return float(config.poses_lr * (config.poses_lr_final / config.poses_lr) ** progress)


def twist_gradient(viewmat: Array, v_viewmat: Array) -> Array:
    """Gradient (6,) by the twist (rotation, translation) of exp(twist) viewmat, at the twist 0."""
    rotation = np.cross(viewmat[:3], v_viewmat[:3], axis=0).sum(axis=1)
    return np.concatenate([rotation, v_viewmat[:3, 3]])


def exponential(twist: Array) -> Array:
    """The rigid motion (4, 4) of a twist (rotation vector, translation), (6,) (Murray, Li, Sastry 1994, eq. 2.36)."""
    w, t = twist[:3], twist[3:]
    angle = float(np.linalg.norm(w))
    hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    # sin(a)/a, (1 - cos(a))/a^2 and (a - sin(a))/a^3, by their series where the last would cancel.
    if angle < 1e-3:
        a, b, c = 1 - angle**2 / 6, 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    else:
        a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
        c = (1 - a) / angle**2
    motion = np.eye(4)
    motion[:3, :3] += a * hat + b * hat @ hat
    motion[:3, 3] = (np.eye(3) + b * hat + c * hat @ hat) @ t
    return motion


def aligned(
    gaussians: Gaussians,
    view: View,
    extent: float,
    config: OptimConfig,
    renderer: Renderer,
) -> View:
    """Move the camera of a held-out view, near its pose, to where the scene matches its photo best.

    Parameters
    ----------
    gaussians : Gaussians
        On the host.
    extent : float
        Scale of the scene, world units.
    config : OptimConfig
        Learning rates and loss of the training.
    renderer : Renderer
    """
    placed, photo = renderer.place(gaussians), renderer.upload("photo", view.image, np.uint8)
    mask = None if view.mask is None else renderer.upload("mask", view.mask, np.uint8)
    pose = start([view.name])
    for k in range(ALIGNING_STEPS):
        camera = refined(view.camera, pose.of(view.name))
        run = renderer.forward(placed, camera)
        _, v_rgb = renderer.stages.l1_ssim(run.image.rgb, photo, config.ssim_weight, mask)
        v_image = Image(v_rgb, renderer.no_alpha_gradient(camera))
        v_viewmat = renderer.backward(run, v_image, camera_grad=True).viewmat
        assert v_viewmat is not None
        update(pose, view.name, camera, v_viewmat, rate_at(k / ALIGNING_STEPS, config), extent, config)
    return replace(view, camera=refined(view.camera, pose.of(view.name)))
