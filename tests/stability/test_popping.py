"""Intersecting Gaussians and a moving camera: the image must not jump when the order of two centres changes."""

import numpy as np
import pytest

from clsplat.bench.stability.popping import STEP, crossing_discs, frame_differences, frames
from clsplat.config import RenderConfig


@pytest.mark.parametrize("path", ["turn", "move"])
def test_nothing_pops(device, path):
    """Popping (StopThePop, Radl et al. 2024).

    When two centres swap, all pixels that both Gaussians cover change at once. With an order per pixel, only the line
    between the Gaussians moves, which changes little.
    """
    worst = {}
    for sort in ("global", "pixel"):
        config = RenderConfig(sort=sort)
        found = frame_differences(device, crossing_discs(60), frames(path, 200, 2 * STEP, width=80), config)
        worst[sort] = found.max() / np.median(found)
    assert worst["global"] > 2.5, "the scene must pop without the remedy"
    assert worst["pixel"] < 1.5
