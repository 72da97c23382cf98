"""Space before a plain background: where it is kept empty, and the sky behind it."""

from dataclasses import replace

import numpy as np
import pytest
from test_sky_start import BLUE, CONFIG, HEIGHT, UP, WIDTH, camera

from clsplat.config import DataConfig, InitConfig
from clsplat.dataset.outlines import free_space, in_free_space
from clsplat.device import Device
from clsplat.scene import Scene, View
from clsplat.training.loop import train
from clsplat.training.sky_start import DISTANCE, beyond, empty_space, sky_cells, sky_gaussians


def in_a_studio(color=(90, 140, 220)):
    """Photos from all around, level and from above, of noise before a plain background."""
    views = []
    for k in range(12):
        angle, height = 2 * np.pi * k / 12, -0.8 * (k % 2)
        image = np.full((HEIGHT, WIDTH, 3), color, np.uint8)
        image[20:40, 30:50] = np.random.default_rng(k).integers(0, 256, (20, 20, 3))
        views.append(View(f"{k}.png", camera((np.cos(angle), height, np.sin(angle)), (0, 0, 0)), image))
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (3000, 3))
    return Scene(views, [], points, np.zeros(points.shape, np.uint8))


def test_a_plain_background_is_sky_below_the_horizon_too() -> None:
    scene = in_a_studio()
    sky, level = sky_gaussians(scene, CONFIG, plain=True), sky_gaussians(scene, CONFIG)
    assert sky is not None and level is not None and (level.means @ UP).min() > -0.1 * DISTANCE * scene.extent
    directions = sky.means / np.linalg.norm(sky.means, axis=1, keepdims=True)
    heights = directions @ UP
    # Cameras 0.8 above look down by 0.67 radians; their photos reach 0.54 farther, and the sky 0.5 beyond them.
    assert heights.min() < -0.98 and heights.max() > 0.7
    np.testing.assert_allclose(0.5 + 0.28209479 * sky.sh[:, 0], np.broadcast_to(BLUE / 255, (len(sky), 3)), atol=1e-6)
    cells, _, edge = sky_cells(scene.train[0], scene.points, None, BLUE / 255)
    assert cells[0].all() and cells[-1].all() and not cells[20 // edge : 40 // edge, 32 // edge : 48 // edge].any()
    white = replace(CONFIG, data=DataConfig(background="white"))
    assert sky_gaussians(in_a_studio((255, 255, 255)), white, plain=True) is None


def test_space_is_kept_empty_where_the_configuration_and_the_points_allow_it() -> None:
    scene = in_a_studio()
    assert len(empty_space(scene, CONFIG)) == 3
    assert empty_space(scene, replace(CONFIG, init=InitConfig(sky=False))) == []
    assert empty_space(scene, replace(CONFIG, strategy="adc")) == [], "it leaves no room for new viewpoints"
    assert empty_space(replace(scene, points=scene.points[:0], colors=scene.colors[:0]), CONFIG) == []
    # Points between the cameras and the object: what looks like a background is a surface.
    for share, count in (0.1, 3), (0.101, 0):
        points = scene.points.copy()
        points[: round(share * len(points))] = 0.5 * scene.train[0].camera.position
        assert len(empty_space(replace(scene, points=points), CONFIG)) == count


@pytest.mark.parametrize("removal", ["in rounds", "at the end"])
def test_a_training_leaves_the_space_before_a_plain_background_free(
    device: Device, tmp_path, monkeypatch: pytest.MonkeyPatch, removal
) -> None:
    """Gaussians of the background's colour in front of the object are in no photo's way, and in that of others."""
    scene = in_a_studio()
    between = 0.5 * np.repeat([view.camera.position for view in scene.train], 4, axis=0)
    points = np.concatenate([scene.points, between + np.random.default_rng(0).normal(0, 0.02, between.shape)])
    colors = np.concatenate([scene.colors, np.tile(BLUE.astype(np.uint8), (len(between), 1))])
    scene, grids, left = replace(scene, points=points, colors=colors), free_space(scene.train), {}
    other = "loop" if removal == "in rounds" else "session"
    monkeypatch.setattr(f"clsplat.training.{other}.in_free_space", lambda means, grids: np.zeros(len(means), bool))
    for sky in True, False:
        init = InitConfig(sky=sky, dense=False)
        config = replace(CONFIG, iterations=60 if removal == "in rounds" else 3, size="fixed", init=init)
        trained = train(scene, replace(config, max_gaussians=6000), tmp_path / str(sky), device)
        left[sky] = int(in_free_space(trained.means, grids).sum())
        assert len(trained) > 1000
        below = trained.means[beyond(trained, scene)] @ UP < -0.5 * DISTANCE * scene.extent
        assert below.any() == sky
    assert left[True] < 0.1 * left[False] if removal == "in rounds" else left[True] == 0 < left[False]
