"""Gaussians that cross, while the camera moves: the image must not jump where the order of two centres changes."""

import numpy as np
import pytest

from clsplat.bench.stability.popping import STEP, crossing_discs, frame_differences, frames
from clsplat.config import RenderConfig


@pytest.mark.parametrize("path", ["turn", "move"])
def test_nothing_pops(device, path):
    """Popping (StopThePop, Radl et al. 2024): when two centres swap, all that both Gaussians cover changes at once; a
    line between them that moves on changes next to nothing."""
    worst = {}
    for sort in ("global", "pixel"):
        config = RenderConfig(sort=sort)
        found = frame_differences(device, crossing_discs(60), frames(path, 200, 2 * STEP, width=80), config)
        worst[sort] = found.max() / np.median(found)
    assert worst["global"] > 2.5, "the scene must pop without the remedy"
    assert worst["pixel"] < 1.5
