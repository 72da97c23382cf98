"""Removal and merging in rounds: the cheapest is chosen, every version has its number of Gaussians."""

import numpy as np
from test_merging import halves
from test_prices import cameras

from clsplat.metrics import psnr, to_uint8
from clsplat.pruning.prices import removal_order
from clsplat.pruning.reductions import cheapest, reduce
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.testing import synthetic_scene


def split_scene():
    """Faint Gaussians of which each is stored as two halves, and its renders."""
    parents = synthetic_scene(20, 5)[0].astype(np.float64)
    parents.logit_opacities -= 1.5
    gaussians = halves(parents).astype(np.float32)
    views = [View(str(i), c, to_uint8(render(gaussians, c, device="reference").rgb)) for i, c in enumerate(cameras())]
    return gaussians, views


def test_the_cheapest_of_both():
    removals, pairs = np.array([5.0, 1.0, 9.0, 9.0, 4.0]), np.array([[0, 1], [2, 3], [3, 4]])
    removed, joined = cheapest(removals, pairs, np.array([0.5, 2.0, 3.0]), 3)
    assert joined.tolist() == [0, 1] and removed.tolist() == [4]
    removed, joined = cheapest(removals, pairs, np.array([1.5, 2.0, 3.0]), 2)
    assert joined.tolist() == [1] and removed.tolist() == [1], "merging 0 and 1 is dearer than removing 1"
    removed, joined = cheapest(removals, pairs[:0], np.zeros(0), 5)
    assert sorted(removed) == [0, 1, 2, 3, 4] and len(joined) == 0


def test_halves_are_merged_and_the_picture_stays(device):
    gaussians, views = split_scene()
    renderer = Renderer(device)
    found = reduce(gaussians, views, lambda left: len(left) <= 20, renderer)
    order = removal_order(gaussians, views, lambda left: len(left) <= 20, renderer)

    def quality(version):
        images = [render(version, v.camera, device="reference").rgb for v in views]
        return np.mean([psnr(image, v.image) for image, v in zip(images, views, strict=True)])

    n = 26
    version = found.pool.take(found.rows(n))
    assert len(found.parents) >= 8
    assert quality(version) > quality(gaussians.take(np.sort(order[:n]))) + 3


def test_every_number_has_its_version(device):
    gaussians, views = split_scene()
    found = reduce(gaussians, views, lambda left: len(left) <= 10, Renderer(device))
    assert found.rows(40).tolist() == list(range(40))
    for n in range(41):
        assert len(found.rows(n)) == n
    for row, pair in enumerate(found.parents, 40):
        assert (found.death[pair] == found.birth[row]).all(), "the merged one takes the place of its parents"
    again = reduce(gaussians, views, lambda left: len(left) <= 10, Renderer(device))
    for name, array in found.pool.arrays().items():
        np.testing.assert_array_equal(array, getattr(again.pool, name))
    np.testing.assert_array_equal(found.death, again.death)


def test_a_single_gaussian(device):
    gaussians, views = split_scene()
    found = reduce(gaussians.take(np.arange(1)), views, lambda left: False, Renderer(device))
    assert found.rows(1).tolist() == [0] and len(found.rows(0)) == 0
