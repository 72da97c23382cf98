"""Stage count: kernel and twin against brute force; there is no gradient."""

import numpy as np
import pytest

from clsplat import ops, reference
from clsplat.config import RenderConfig
from clsplat.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from clsplat.renderer import Renderer
from clsplat.stages import Splats
from clsplat.testing import synthetic_scene


def brute_force_pairs(splats, bins):
    """Evaluated and accepted pairs per pixel: every splat against every pixel, in NumPy."""
    height, width, size = bins.height, bins.width, bins.tile_size
    y, x = np.mgrid[:height, :width]
    tile = y // size * -(-width // size) + x // size
    listed = np.zeros((len(bins.tile_ranges), len(splats.depths)), dtype=bool)
    for t, (begin, end) in enumerate(bins.tile_ranges):
        listed[t, bins.gauss_ids[begin:end]] = True
    evaluated, accepted = np.zeros((2, height, width), dtype=int)
    transmittance, live = np.ones((height, width)), np.ones((height, width), dtype=bool)
    shown = splats.extents[:, 0] > 0
    for g in np.flatnonzero(shown)[np.argsort(splats.depths[shown], kind="stable")]:
        dx, dy = x + 0.5 - splats.means2d[g, 0], y + 0.5 - splats.means2d[g, 1]
        a, b, c = splats.conics[g]
        sigma = (a * dx**2 + c * dy**2) / 2 + b * dx * dy
        alpha = np.minimum(splats.opacities[g] * np.exp(-sigma), ALPHA_MAX)
        box = (abs(dx) <= splats.extents[g, 0]) & (abs(dy) <= splats.extents[g, 1])
        evaluated += live & box & listed[tile, g]
        reached = live & (alpha >= ALPHA_MIN)
        behind = transmittance * (1 - alpha)
        drawn = reached & (behind > TRANSMITTANCE_MIN)
        accepted += drawn
        live &= ~reached | drawn
        transmittance = np.where(drawn, behind, transmittance)
    return evaluated, accepted, live


@pytest.mark.parametrize("tile_size", [8, 16, 32])
def test_pairs_are_those_of_brute_force(device64, tile_size):
    gaussians, camera = synthetic_scene(300, seed=3)
    gaussians.logit_opacities[:] += 1
    gaussians.logit_opacities[::4] = 9  # clamped at ALPHA_MAX near their centres
    config = RenderConfig(tile_size=tile_size)
    run = Renderer(device64, config).forward(gaussians, camera, 0)
    splats = Splats(*(array.get() for array in run.splats))
    bins = reference.bin_splats(splats, camera.width, camera.height, tile_size)
    evaluated, accepted, live = brute_force_pairs(splats, bins)
    assert 0.1 < live.mean() < 0.9, "the scene must have pixels that stop and pixels that do not"
    assert (evaluated > accepted).mean() > 0.5, "boxes must hold pairs that are not drawn"
    kernel = [array.get() for array in ops.count_pairs(device64, run.splats, run.bins)]
    for found in (kernel, reference.count_pairs(splats, bins)):
        np.testing.assert_array_equal(found[0], evaluated)
        np.testing.assert_array_equal(found[1], accepted)


def test_nothing_visible_counts_nothing(any_device):
    gaussians, camera = synthetic_scene(5, seed=1)
    gaussians.logit_opacities[:] = -20  # below ALPHA_MIN
    run = Renderer(any_device).forward(gaussians, camera, 0)
    for count in ops.count_pairs(any_device, run.splats, run.bins):
        assert count.shape == (camera.height, camera.width)
        assert not count.get().any()
