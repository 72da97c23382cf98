"""Equal depths and rounded sums: the same input gives the same bits."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.bench.stability.order import _wall
from clsplat.config import RenderConfig
from clsplat.render import render
from clsplat.testing import synthetic_scene


@pytest.mark.parametrize("sort", ["global", "per_tile"])
def test_ties_have_one_order(configured_device, sort):
    """Of two splats at the same depth, the one with the lower index is in front, as in the twin.

    With a sort that is not stable, the order of the two would be arbitrary.
    """
    gaussians, camera = _wall(300)
    config = RenderConfig(sort=sort)
    scene = gaussians.astype(np.float32)
    found = render(scene, camera, config, configured_device, gradients=False).rgb
    twin = render(scene, camera, config, gradients=False, device="reference").rgb
    turned = render(scene.take(np.arange(300)[::-1]), camera, config, gradients=False, device="reference").rgb
    # Two orders of the ties give different images, and the device uses the order of the twin.
    assert np.abs(turned - twin).max() > 0.1
    assert np.abs(found - twin).max() < 0.01
    np.testing.assert_array_equal(render(scene, camera, config, configured_device, gradients=False).rgb, found)


def test_rows_in_another_order_change_nothing(device):
    """If no depths are equal, the order of the rows does not matter: sums are ordered by depth."""
    gaussians, camera = synthetic_scene(500, seed=1)
    scene = gaussians.astype(np.float32)
    rows = np.random.default_rng(0).permutation(500)
    np.testing.assert_array_equal(
        render(scene.take(rows), camera, device=device, gradients=False).rgb,
        render(scene, camera, device=device, gradients=False).rgb,
    )


def test_runs_repeat_to_the_bit(configured_device):
    """Float atomics add in the order in which work-items arrive (Brush #525, INRIA #89)."""
    gaussians, camera = synthetic_scene(500, seed=1, width=64, height=48)
    scene = replace(gaussians, log_scales=gaussians.log_scales + 1).astype(np.float32)  # many splats in each pixel

    def gradients():
        rendering = render(scene, camera, device=configured_device)
        return rendering.backward(rendering.rgb).gaussians

    first = gradients()
    assert np.abs(first.means).max() > 0
    for _ in range(3):
        for name, array in gradients().arrays().items():
            np.testing.assert_array_equal(array, getattr(first, name), err_msg=name)
