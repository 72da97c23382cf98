"""Scenes rendered at other scales than that of their photos."""

import numpy as np
import pytest
from other_scales import SCALES, scales

from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.render import render
from clsplat.testing import synthetic_scene


def test_distance_does_not_change_the_mean_alpha(device):
    """The dilation by 0.3 px^2 enlarges everything that is smaller than a pixel (Mip-Splatting).

    With compensated opacity, the mean alpha of the image stays about the same.
    """
    rng = np.random.default_rng(0)
    gaussians = synthetic_scene(200, sh_degree=0)[0]
    gaussians.means[:] = rng.uniform(-1, 1, (200, 3)) * [1, 1, 0.1]
    gaussians.log_scales[:] = np.log(0.008)
    gaussians.logit_opacities[:] = 2
    scene = gaussians.astype(np.float32)
    total = {}
    for mode in ("classic", "antialiased"):
        for width in (480, 60):
            camera = Camera.look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), 1.5 * width, width, width)
            alpha = render(scene, camera, RenderConfig(mode=mode), device, gradients=False).alpha
            total[mode, width] = float(alpha.mean())
    growth = {mode: total[mode, 60] / total[mode, 480] for mode in ("classic", "antialiased")}
    assert growth["classic"] > 4
    assert 0.8 < growth["antialiased"] < 1.3


@pytest.mark.slow
@pytest.mark.shared
def test_photos_of_one_scale_make_a_scene_for_others(device, shared):
    """At a quarter of the scale, the filters gain at least 3 dB. At larger scales, they lose nothing.

    At the scale of the photos, the 3D filter costs 1.0 dB in short trainings, and the 2D filter 0.3 dB.
    """
    series = {label: dict(points) for label, points in scales(device, shared / "data").plot.series.items()}
    for label, cost in (("2D filter", 0.5), ("2D and 3D filter", 1.2)):
        assert series[label][0.25] > series["classic"][0.25] + 3
        for scale in SCALES:
            assert series[label][scale] > series["classic"][scale] - (cost if scale == 1 else 0), (label, scale)
