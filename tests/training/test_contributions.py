"""Contributions of Gaussians to photos, against the float64 twins splat by splat."""

import numpy as np
import pytest

from clsplat.device import Device
from clsplat.metrics import to_uint8
from clsplat.reference.composite import hits
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.testing import synthetic_scene
from clsplat.training.contributions import contributions
from clsplat.training.densify import Contributions

N, BACKGROUND = 30, (0.2, 0.4, 0.1)


@pytest.mark.parametrize("on_device", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_weights_and_errors_are_those_of_the_pixels(device: Device, on_device: bool, masked: bool) -> None:
    gaussians, camera = synthetic_scene(N, seed=2)
    gaussians = gaussians.astype(np.float32)
    rng = np.random.default_rng(0)
    image = to_uint8(
        render(gaussians, camera, background=BACKGROUND, device="reference").rgb
        + rng.normal(0, 0.2, (camera.height, camera.width, 3))
    )
    mask = rng.random((camera.height, camera.width)) < 0.5 if masked else None
    views = [View("a.png", camera, image, mask), View("b.png", camera, 255 - image)]
    given = Renderer(device).place(gaussians) if on_device else gaussians
    found = contributions(Renderer(device, background=BACKGROUND), given, views, 3)

    run = Renderer("reference", background=BACKGROUND).forward(gaussians, camera, 3)
    expected = Contributions(*(np.zeros(N) for _ in range(5)))
    for view in views:
        residuals = run.image.rgb - view.image / 255
        counted = np.ones(residuals.shape[:2]) if view.mask is None else view.mask.astype(float)
        squares = (residuals**2).sum(axis=2) * counted
        transmittance = np.empty(squares.shape)
        for hit in hits(run.splats, run.bins, transmittance):
            weight = hit.alpha * hit.before
            expected.weights[hit.splat] += (weight * counted[hit.box]).sum()
            expected.errors[hit.splat] += (weight * squares[hit.box]).sum()
            expected.pairs[hit.splat] += ((weight > 0) * counted[hit.box]).sum()
        for i in range(0, N, 7):
            without = gaussians.take(np.delete(np.arange(N), i))
            image = render(without, camera, background=BACKGROUND, device="reference").rgb
            expected.prices[i] += (((image - view.image / 255) ** 2).sum(axis=2) * counted).sum() - squares.sum()
            expected.differences[i] += (((image - run.image.rgb) ** 2).sum(axis=2) * counted).sum()
    assert (expected.weights > 0).any()
    # float32: sums over some thousand pixels; of each a fraction of the largest.
    for actual, wanted in zip(found[:5], expected[:5], strict=True):
        some = slice(0, N, 7) if wanted is expected.prices or wanted is expected.differences else slice(None)
        np.testing.assert_allclose(actual[some], wanted[some], rtol=1e-4, atol=1e-5 * np.abs(wanted).max())
