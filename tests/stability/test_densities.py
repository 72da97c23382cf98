"""Transparent Gaussians: all of a scene's Gaussians, and single ones that no pixel shows."""

from dataclasses import replace

import numpy as np

from clsplat.bench.stability.everything_pruned import left_by_pruning
from clsplat.bench.stability.small import CONFIG, small_scene
from clsplat.constants import ALPHA_MIN
from clsplat.gaussians import logit
from clsplat.pruning.prices import without_invisible
from clsplat.render import render
from clsplat.testing import synthetic_scene
from clsplat.training.loop import train


def test_training_goes_on_where_everything_has_become_transparent(device, tmp_path):
    """INRIA #472, #482: if photos are as black as the background, all Gaussians become transparent and are pruned."""
    assert left_by_pruning(0) == 0 and left_by_pruning(16) == 16
    scene = small_scene(device)
    dark = replace(scene, train=[replace(view, image=np.zeros_like(view.image)) for view in scene.train])
    config = replace(CONFIG, iterations=120, adc=replace(CONFIG.adc, opacity_min=0.9, every=10, start=10))
    counts = []
    gaussians = train(dark, config, tmp_path, device, progress=lambda record: counts.append(record["num_gaussians"]))
    assert min(counts) == config.adc.min_gaussians
    assert all(np.isfinite(array).all() for array in gaussians.arrays().values())


def test_invisible_gaussians_are_not_saved(device):
    """gsplat #822: MCMC leaves dead Gaussians. Without those below ALPHA_MIN, every image has the same bits."""
    gaussians, camera = synthetic_scene(300, seed=1)
    gaussians = gaussians.astype(np.float32)
    gaussians.logit_opacities[::3] = logit(np.float32(ALPHA_MIN * 0.999))
    gaussians.logit_opacities[1::3] = logit(np.float32(ALPHA_MIN * 1.001))
    kept = without_invisible(gaussians)
    assert len(kept) == 200
    for one, other in zip(
        *(render(g, camera, device=device, gradients=False).rgb for g in (gaussians, kept)), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    gaussians.logit_opacities[:] = -9
    assert len(without_invisible(gaussians)) == 1, "formats require at least one"
