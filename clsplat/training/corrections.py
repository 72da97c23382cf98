"""Corrections per photo around a step: camera, mask and background before it, exposure within it, pose after it."""

from typing import Any, NamedTuple, SupportsFloat

import numpy as np

from clsplat.camera import Camera
from clsplat.config import BACKGROUNDS, OptimConfig, TrainConfig
from clsplat.randomness import stream
from clsplat.renderer import Renderer
from clsplat.scene import Color, View
from clsplat.stages import CameraGrads, Image
from clsplat.training import photo_exposures, photo_poses
from clsplat.training.memory import Photos
from clsplat.training.state import State


class Example(NamedTuple):
    """A photo as an iteration trains on it: its pixels and mask on the device, the camera with its refined pose, the
    background that both photo and render have, and if it has a depth map, its inverse depths and their unit."""

    name: str
    camera: Camera
    photo: Any
    mask: Any
    background: Color
    disparities: Any = None
    unit: float = 0.0


def example(
    view: View, iteration: int, state: State, photos: Photos, config: TrainConfig, renderer: Renderer
) -> Example:
    """Prepare a view for an iteration."""
    camera = photo_poses.refined(view.camera, state.poses.of(view.name)) if state.poses else view.camera
    photo, mask, disparities, unit = photos(view)
    background = BACKGROUNDS[config.data.background]
    if config.data.random_background:
        drawn = tuple(stream(config.seed, "backgrounds", iteration).random(3).tolist())
        if view.clear is not None:
            photo = renderer.upload("photo", view.on(drawn, background), np.uint8)
        background = drawn
    return Example(view.name, camera, photo, mask, background, disparities, unit)


def compare(
    image: Image, seen: Example, progress: float, state: State, config: TrainConfig, renderer: Renderer
) -> tuple[SupportsFloat, Image]:
    """Loss of a render against its photo, and its gradients; takes a step on the photo's exposure, if it is learned.

    Parameters
    ----------
    image : Image
        The render.
    seen : Example
        The photo.
    progress : float
        Fraction of the training, 0 to 1.

    Returns
    -------
    loss : convertible to float
        That of a device is waited for when it is converted.
    v_image : Image
        Gradients with respect to the render.
    """
    stages, rgb, by_depth = renderer.stages, image.rgb, 0.0
    if seen.disparities is not None:
        weight = depth_weight(progress, config.optim) / (seen.unit * seen.disparities.size)
        by_depth, rgb = stages.disparity_loss(image.rgb, seen.disparities, weight)
    plain = rgb
    if state.exposures:
        affine = state.exposures.of(seen.name)
        rgb = stages.exposure_fwd(plain, affine, seen.photo)
    loss, v_rgb = stages.l1_ssim(rgb, seen.photo, config.optim.ssim_weight, seen.mask)
    if state.exposures:
        v_affine = stages.exposure_bwd(plain, affine, seen.photo, v_rgb)
        photo_exposures.update(state.exposures, seen.name, v_affine, progress, config.optim)
    if seen.disparities is not None:
        v_rgb = stages.disparity_grad(image.rgb, seen.disparities, weight, v_rgb)
        loss = float(loss) + by_depth
    return loss, Image(v_rgb, renderer.no_alpha_gradient(seen.camera))


def depth_weight(progress: float, config: OptimConfig) -> float:
    """Weight of the relative difference from a depth map; it changes exponentially with progress, 0 to 1."""
    return config.depth_weight * (config.depth_weight_final / config.depth_weight) ** progress


def learn_pose(
    seen: Example, v_camera: CameraGrads | None, progress: float, state: State, config: TrainConfig
) -> None:
    """Take a step on a photo's pose, if poses are learned."""
    if state.poses and v_camera:
        rate = photo_poses.rate_at(progress, config.optim)
        photo_poses.update(state.poses, seen.name, seen.camera, v_camera.viewmat, rate, state.extent, config.optim)
