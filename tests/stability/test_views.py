"""Directions without a photo: colours from other sides, needles, and Gaussians next to a camera."""

from dataclasses import replace

import numpy as np
import pytest
from needles_and_floaters import effective_rank

from clsplat.bench.stability.sh_extrapolation import unseen_side
from clsplat.bench.stability.small import CONFIG, small_scene
from clsplat.bench.stability.trained import trained
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.render import render
from clsplat.testing import synthetic_scene


def test_unseen_sides_keep_their_colour(device):
    """Bands that four photos do not constrain have arbitrary colours on the other side."""
    assert unseen_side(0, device) > unseen_side(3, device) + 0.6  # measured: 22.6 and 21.4 dB


@pytest.mark.slow
@pytest.mark.shared
def test_the_regulariser_leaves_fewer_needles(device, shared):
    """Regulariser of the effective rank (Hyung et al. 2024)."""
    plain, regular, *_ = (figure.value for figure in effective_rank(device, shared / "data").figures)
    assert plain > 2 * regular


def test_gaussians_next_to_a_camera_are_not_drawn(any_device):
    """A ball of 0.1 next to the camera, 0.1 in front of its plane and 50 degrees above its axis.

    Such a Gaussian covered a held-out photo of castle_p30. The affine projection is not valid there.
    """
    camera = Camera(np.eye(4), 95, 95, 48, 32, 96, 64)
    ball = synthetic_scene(1, sh_degree=0)[0]
    ball.means[:], ball.log_scales[:], ball.logit_opacities[:] = [0, -0.12, 0.1], np.log(0.1), 3
    gaussians = ball.astype(any_device.real)
    covered = {
        near: render(gaussians, camera, RenderConfig(near=near), any_device, gradients=False).alpha.mean()
        for near in (0.01, 0.2)
    }
    assert covered[0.01] > 0.3 and covered[0.2] == 0


def test_gaussians_that_no_photo_shows_are_removed(device):
    """Gaussians above the frames of all photos would otherwise wait there for a camera."""
    scene = small_scene(device)
    above = np.array([[0, -20.0 - i, 0] for i in range(5)])
    scene = replace(
        scene, points=np.vstack([scene.points, above]), colors=np.full((len(scene.points) + 5, 3), 128, np.uint8)
    )
    config = replace(CONFIG, iterations=60, max_gaussians=len(scene.points))
    left = {strategy: trained(scene, replace(config, strategy=strategy), device) for strategy in ("adc", "error")}
    waiting = {strategy: int((gaussians.means[:, 1] < -10).sum()) for strategy, gaussians in left.items()}
    assert waiting == {"adc": 5, "error": 0}
    assert len(left["error"]) == len(scene.points) - 5
