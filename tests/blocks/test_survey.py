"""The survey: weights are those of compositing, photos cover a block, and a block sees its part of each photo."""

from dataclasses import replace

import numpy as np
import pytest
from small_run import known_scene

from clsplat.blocks.survey import COVERED, block_weights, chosen_photos, seen_by_block, shown_in, survey, weights
from clsplat.config import InitConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.renderer import Renderer
from clsplat.testing import synthetic_scene
from clsplat.training.initialize import initialize


def test_weights_are_those_of_compositing(device: Device) -> None:
    gaussians, camera = synthetic_scene(50)
    view = replace(known_scene().train[0], camera=camera, image=np.zeros((camera.height, camera.width, 3), np.uint8))
    mask = np.random.default_rng(0).random((camera.height, camera.width)) < 0.5
    reference = Renderer("reference")
    run = reference.forward(gaussians, camera)
    expected = reference.stages.removal(run.splats, run.bins, np.zeros(3), None, mask).weights
    (found,) = weights(Renderer(device), gaussians.astype(np.float32), [replace(view, mask=mask)])
    # Sums of weights up to 1 over some hundred pixels in single precision; splats at a threshold may differ.
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=0.02)
    hidden = replace(view, mask=np.zeros_like(mask))
    surveyed = survey(Renderer(device), gaussians.astype(np.float32), [hidden, replace(view, mask=mask)])
    np.testing.assert_allclose(surveyed.toarray(), [np.zeros(50), found], rtol=1e-6)
    assert surveyed.nnz == (found > 0).sum(), "zeros take no memory"
    blocks = np.arange(50) % 3
    sums = block_weights(surveyed, blocks, 3)
    np.testing.assert_allclose(sums, [np.zeros(3), np.bincount(blocks, expected, 3)], rtol=1e-3)
    assert not shown_in(surveyed, np.array([0])).any()
    np.testing.assert_array_equal(shown_in(surveyed, np.array([0, 1])), found > 0)


@pytest.mark.parametrize(
    ("shares", "fewest", "expected"),
    [
        ([5, 90, 0, 5], 1, [0, 1]),
        ([5, 90, 0, 5], 3, [0, 1, 3]),
        ([1, 1, 1, 1], 1, [0, 1, 2, 3]),
        ([0, 0, 7], 1, [2]),
        ([0, 0, 7], 9, [0, 1, 2]),
    ],
)
def test_photos_cover_a_block(shares: list[float], fewest: int, expected: list[int]) -> None:
    assert COVERED == 0.95
    assert chosen_photos(np.array(shares, float), fewest).tolist() == expected


@pytest.mark.parametrize("where", ["device", "reference"])
def test_a_block_sees_its_part_of_a_photo(device: Device, where: str) -> None:
    scene = known_scene()
    view = scene.train[0]
    coarse = initialize(scene, InitConfig(opacity=0.7), seed=0)
    renderer = Renderer(device if where == "device" else "reference")
    image = to_uint8(
        renderer.forward(coarse, view.camera).image.rgb if where == "reference" else _image(renderer, coarse, view)
    )
    every, none = np.ones(len(coarse), bool), np.zeros(len(coarse), bool)

    (all_of_it,), shown = seen_by_block(renderer, coarse, every, [view])
    covered = _alpha(renderer, coarse, view) > 0.1
    np.testing.assert_array_equal(all_of_it.image[covered], view.image[covered])
    assert shown.any()

    (nothing,), again = seen_by_block(renderer, coarse, none, [view])
    np.testing.assert_array_equal(nothing.image, image)
    np.testing.assert_array_equal(again, shown)

    left = coarse.means[:, 0] < 0
    halves = [seen_by_block(renderer, coarse, part, [view])[0][0].image.astype(int) for part in (left, ~left)]
    # The parts of the difference add up to the whole, to half a level of rounding each and that of the image.
    total = sum(half - image for half in halves)
    assert np.abs(total - (view.image.astype(int) - image))[covered].max() <= 2
    assert all(np.abs(half - image).max() > 20 for half in halves)


@pytest.mark.parametrize("most", [1, 30])
def test_a_block_sees_the_same_where_the_device_holds_few_gaussians(device: Device, most: int) -> None:
    scene = known_scene()
    coarse = initialize(scene, InitConfig(opacity=0.7), seed=0)
    coarse.log_scales -= 2
    trains, renderer, placed = coarse.means[:, 0] < 0, Renderer(device), []
    # The photos are narrow, so that each shows a part of the scene.
    views = [replace(v, camera=replace(v.camera, fx=4 * v.camera.fx, fy=4 * v.camera.fy)) for v in scene.train[:4]]
    expected, shown = seen_by_block(renderer, coarse, trains, views)
    place = renderer.place

    def counted(gaussians: Gaussians) -> Gaussians:
        placed.append(len(gaussians))
        return place(gaussians)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(renderer, "place", counted)
        found, again = seen_by_block(renderer, coarse, trains, views, most=most)
    np.testing.assert_array_equal(again, shown)
    assert [view.name for view in found] == [view.name for view in views]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
    assert 0 < max(placed) < len(coarse)


def _image(renderer: Renderer, gaussians, view):
    return renderer.forward(gaussians, view.camera).image.rgb.get()


def _alpha(renderer: Renderer, gaussians, view):
    alpha = renderer.forward(gaussians, view.camera).image.alpha
    return alpha if isinstance(alpha, np.ndarray) else alpha.get()
