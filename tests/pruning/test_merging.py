"""Merging pairs: moments, halves of one Gaussian, and the estimated cost against rendering."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.gaussians import Gaussians, logit
from clsplat.metrics import to_uint8
from clsplat.pruning.merging import _areas, _depths, covariances, merge_costs, merged, merged_as_seen, neighbours
from clsplat.pruning.prices import Prices, price
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.testing import synthetic_scene

PAIRS = np.array([[0, 1], [2, 3], [4, 5]])


def halves(parents, offset=0.6):
    """Two Gaussians for each one, whose mixture has its mass, mean and covariance: apart along its first axis."""
    scales, axes = np.exp(parents.log_scales), covariances(parents)
    values, vectors = np.linalg.eigh(axes)
    shift = offset * np.sqrt(values[:, -1:]) * vectors[:, :, -1]
    longest = scales.argmax(axis=1)[:, None]
    narrow = scales.copy()
    np.put_along_axis(narrow, longest, np.take_along_axis(scales, longest, 1) * np.sqrt(1 - offset**2), 1)
    depths = _depths(parents.opacities) * _areas(scales) / _areas(narrow) / 2
    sides = [
        Gaussians(
            parents.means + side * shift, np.log(narrow), parents.quats, logit(-np.expm1(-depths)), parents.sh.copy()
        )
        for side in (-1, 1)
    ]
    both = Gaussians.concatenate(sides)
    return both.take(np.arange(2 * len(parents)).reshape(2, -1).T.ravel())


def assert_same(found, expected):
    np.testing.assert_allclose(found.means, expected.means, atol=1e-9)
    np.testing.assert_allclose(covariances(found), covariances(expected), rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found.opacities, expected.opacities, rtol=1e-8)
    np.testing.assert_allclose(found.sh, expected.sh, atol=1e-12)


def test_moments_of_the_mixture_are_kept():
    gaussians = synthetic_scene(6, 0)[0].astype(np.float64)
    found = merged(gaussians, PAIRS)
    mass = _depths(gaussians.opacities) * _areas(gaussians.scales)
    for k, (i, j) in enumerate(PAIRS):
        w = mass[[i, j]] / mass[[i, j]].sum()
        mean = w @ gaussians.means[[i, j]]
        second = sum(
            w[m] * (covariances(gaussians)[g] + np.outer(gaussians.means[g], gaussians.means[g]))
            for m, g in enumerate((i, j))
        )
        np.testing.assert_allclose(found.means[k], mean, atol=1e-12)
        np.testing.assert_allclose(covariances(found)[k], second - np.outer(mean, mean), atol=1e-10)
        np.testing.assert_allclose(found.sh[k], np.einsum("m,mac->ac", w, gaussians.sh[[i, j]]), atol=1e-12)
        total = _depths(found.opacities[k : k + 1]) * _areas(found.scales[k : k + 1])
        assert total[0] == pytest.approx(mass[[i, j]].sum(), rel=1e-6)


def test_halves_become_their_parent():
    parents = synthetic_scene(3, 1)[0].astype(np.float64)
    assert_same(merged(halves(parents), PAIRS), parents)
    np.testing.assert_array_equal(neighbours(halves(parents, 1e-3))[:1], [[0, 1]])


def test_two_at_one_place_show_what_both_showed():
    one = synthetic_scene(1, 2)[0].astype(np.float64)
    found = merged(one.take(np.array([0, 0])), np.array([[0, 1]]))
    assert found.opacities[0] == pytest.approx(1 - (1 - one.opacities[0]) ** 2)
    np.testing.assert_allclose(covariances(found), covariances(one), rtol=1e-9)


def test_no_pairs_and_the_type():
    gaussians = synthetic_scene(4, 2)[0].astype(np.float32)
    found = merged(gaussians, np.zeros((0, 2), int))
    assert len(found) == 0 and found.means.dtype == np.float32 and found.sh.shape == (0, *gaussians.sh.shape[1:])


def pair_in_view(gap, color):
    """Two faint Gaussians beside each other in front of black, and a view of them."""
    pair = synthetic_scene(2, 0)[0].astype(np.float64)
    pair.means[:], pair.log_scales[:], pair.logit_opacities[:], pair.sh[:] = 0, np.log(0.25), -1.0, 0
    pair.means[:, 0] = -gap / 2, gap / 2
    pair.sh[:, 0] = 1.0
    pair.sh[1, 0] += color
    camera = Camera.look_at((0, 0, 3.5), (0, 0, 0), (0, 1, 0), 60.0, 64, 48)
    return pair, View("a", camera, to_uint8(render(pair, camera, device="reference").rgb))


@pytest.mark.parametrize(("gap", "color"), [(0.5, 0), (0.9, 0), (0.3, -1.0), (0.6, 0.5)])
def test_cost_is_what_rendering_shows(gap, color):
    pair, view = pair_in_view(gap, color)
    prices = price(pair, [view], Renderer("reference"))
    one = np.array([[0, 1]])
    before = render(pair, view.camera, device="reference").rgb
    after = render(merged_as_seen(pair, one, prices), view.camera, device="reference").rgb
    actual = ((after - before) ** 2).sum(axis=2).mean()
    assert merge_costs(pair, one, prices)[0] == pytest.approx(actual, rel=0.3)
    assert actual < prices.costs.min() or gap > 0.8


def test_what_is_hidden_counts_less():
    pair, view = pair_in_view(0.5, 0)
    pair.means[1, 2] = -0.3
    pair.logit_opacities[:] = 5.0, 0.0
    prices = price(pair, [view], Renderer("reference"))
    one = np.array([[0, 1]])
    seen, plain = merged_as_seen(pair, one, prices), merged(pair, one)
    assert abs(seen.means[0, 0] - pair.means[0, 0]) < 0.9 * abs(plain.means[0, 0] - pair.means[0, 0])


def prices_of(weights, grains):
    """Of Gaussians with these sums of weights, and squared sizes of their pixels."""
    n = len(weights)
    zeros = np.zeros(n)
    return Prices(zeros, zeros, np.array(weights), np.ones(n), np.zeros((n, 3)), np.array(grains), np.zeros((n, 1)))


def unlike_spheres():
    """Of standard deviations 1 and 0.1 at x = 0 and 1, with the same optical depth times area."""
    depths = np.array([0.01, 1.0])
    return Gaussians(
        np.array([[0.0, 0, 0], [1, 0, 0]]),
        np.log([[1.0] * 3, [0.1] * 3]),
        np.tile([1.0, 0, 0, 0], (2, 1)),
        logit(-np.expm1(-depths)),
        np.zeros((2, 1, 3)),
    )


def test_the_blur_of_a_pixel_hides_nothing():
    """Unobstructed, a Gaussian has its opacity times its area with the blur, 0.3 pixels squared (BLUR)."""
    spheres, one = unlike_spheres(), np.array([[0, 1]])
    grains = [0.5, 0.2]
    areas = np.array([1 + 0.3 * grains[0], 0.01 + 0.3 * grains[1]])
    found = merged_as_seen(spheres, one, prices_of(spheres.opacities * areas, grains))
    assert_same(found, merged(spheres, one))


@pytest.mark.parametrize(("shown", "x"), [([1, 0], 0.001 / 1.001), ([0, 1], 1 / 1.001), ([0, 0], 0.5)])
def test_what_no_view_shows_has_a_thousandth_of_its_mass(shown, x):
    """VISIBLE_MIN; if no view shows either, both have their whole mass."""
    spheres, one = unlike_spheres(), np.array([[0, 1]])
    weights = shown * spheres.opacities * np.array([1, 0.01])
    found = merged_as_seen(spheres, one, prices_of(weights, [0.0, 0.0]))
    np.testing.assert_allclose(found.means, [[x, 0, 0]], rtol=1e-9)


def test_pairs_are_neighbours_once():
    gaussians = synthetic_scene(50, 3)[0]
    pairs = neighbours(gaussians)
    assert (pairs[:, 0] < pairs[:, 1]).all() and len(np.unique(pairs, axis=0)) == len(pairs)
    distances = np.linalg.norm(gaussians.means[:, None] - gaussians.means, axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = {tuple(sorted((i, int(j)))) for i, j in enumerate(distances.argmin(axis=1))}
    assert nearest <= set(map(tuple, pairs))
