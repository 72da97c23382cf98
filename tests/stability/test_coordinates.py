"""Coordinates of the world. Geo-referenced scenes: float32 has steps of 0.06 at 1e6, and of 0.5 at 5e6. Units: a
scene in kilometres or in micrometres."""

from dataclasses import replace

import numpy as np
import pytest
from test_loading import write_colmap

from clsplat.bench.stability.small import CONFIG, small_scene
from clsplat.config import DataConfig, InitConfig
from clsplat.dataset import load_scene
from clsplat.dataset.loading import _near_origin
from clsplat.dataset.near_planes import with_near_planes
from clsplat.evaluate import mean_metrics
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import Scene
from clsplat.training.initialize import initialize
from clsplat.training.loop import train


def test_the_same_image_in_coordinates_of_the_world(device, tmp_path):
    """A dataset in geo-referenced coordinates (UTM: up to 1e7) is rendered like the same one at the origin."""
    images = []
    for name, centre in (("far", (5e6, -4e5, 3e5)), ("near", (0.0, 0.0, 0.0))):
        write_colmap(tmp_path / name, centre=centre)
        scene = load_scene(tmp_path / name, DataConfig())
        gaussians = initialize(scene, InitConfig(), seed=0)
        gaussians.log_scales[:] = -1
        gaussians.logit_opacities[:] = 2
        gaussians.sh[:, 0] = [[0, 1, 0], [1, 0, 1]]  # the points are dark
        images.append(render(gaussians, scene.test[0].camera, device=device, gradients=False).rgb)
    assert images[0].std(axis=(0, 1)).min() > 0.1, "both Gaussians must be visible"
    np.testing.assert_allclose(images[0], images[1], atol=1e-5)


def test_training_is_the_same_a_million_units_away(device, tmp_path):
    """The origin is moved to the cameras in float64. At 1e6, positions in float32 would have steps of 0.06."""
    scene, offset = small_scene(device), np.array([1e6, -1e6, 1e6])

    def far(views):
        return [replace(view, camera=view.camera.translated(-offset)) for view in views]

    there = _near_origin(Scene(far(scene.train), far(scene.test), scene.points + offset, scene.colors))
    assert np.abs(there.offset - offset).max() < 10
    config = replace(CONFIG, iterations=100)
    psnrs = [
        mean_metrics(train(s, config, tmp_path, device), s.test, Renderer(device))["psnr"] for s in (scene, there)
    ]
    assert abs(psnrs[0] - psnrs[1]) < 0.01


@pytest.mark.parametrize("points", [True, False], ids=["points", "random"])
def test_training_is_the_same_in_any_unit(device, tmp_path, points):
    """Near planes, scales, learning rates and thresholds follow the scene."""
    scene, config = small_scene(device), replace(CONFIG, iterations=100)
    if not points:
        scene = replace(scene, points=scene.points[:0], colors=scene.colors[:0])
        config = replace(config, init=replace(config.init, random_points=200, triangulate=False))
    psnrs = {}
    for unit in (1.0, 1e-6, 1e-3, 1e3, 1e6):

        def scaled(views, unit=unit):
            viewmats = [view.camera.viewmat.copy() for view in views]
            for viewmat in viewmats:
                viewmat[:3, 3] *= unit
            pairs = zip(views, viewmats, strict=True)
            return [replace(view, camera=replace(view.camera, viewmat=viewmat)) for view, viewmat in pairs]

        there = replace(scene, train=scaled(scene.train), test=scaled(scene.test), points=unit * scene.points)
        gaussians = train(there, config, tmp_path / f"{unit:g}", device)
        views = with_near_planes(there).test
        psnrs[unit] = mean_metrics(gaussians, views, Renderer(device))["psnr"]
    assert max(psnrs.values()) - min(psnrs.values()) < 0.1, psnrs
