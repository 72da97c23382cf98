"""Stage histograms: losses in numbers, against the twin and central differences."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.testing import assert_matches, gradcheck

SCALE = 0.3


def histograms(rays=15, count=8, outer=11):
    """Edges and weights of rays, and those of proposals; some bound the weights, some do not."""
    rng = np.random.default_rng(0)
    edges, outer_edges = (np.sort(rng.uniform(size=(rays, n + 1)), axis=1) for n in (count, outer))
    outer_edges[0] = np.linspace(0, 1, outer + 1)
    edges[0] = outer_edges[0, : count + 1]  # edges that touch do not overlap
    weights, outer_weights = rng.uniform(size=rays * count) ** 2, 0.5 * rng.uniform(size=rays * outer) ** 2
    return [a.astype(np.float32).astype(np.float64) for a in (edges, weights, outer_edges, outer_weights)]


def by_kernel(device, name, *arrays):
    return [a.get() for a in getattr(ops, name)(device, *[device.upload("array", a) for a in arrays], SCALE)]


def test_interlevel_in_numbers(any_device):
    """Intervals [0, 1], [1, 2] and [2, 3] of weights 0.5, 0.2, 0; outer [0, 1.5] and [1.5, 3] of 0.1 and 0.3."""
    given = np.array([[0.0, 1, 2, 3]]), np.array([0.5, 0.2, 0]), np.array([[0, 1.5, 3]]), np.array([0.1, 0.3])
    twin = reference.histograms_interlevel(*given, SCALE)
    for losses, v in (twin, by_kernel(any_device, "histograms_interlevel", *given)):
        np.testing.assert_allclose(losses, [0.4**2 / 0.5], rtol=1e-5)  # the second is bounded by both
        np.testing.assert_allclose(v, [-2 * SCALE * 0.4 / 0.5, 0], rtol=1e-5)


def test_distortion_in_numbers(any_device):
    """Two intervals of lengths 1 and 2 whose middles are 1.5 apart, as the integral of |s - s'| over both."""
    given = np.array([[0.0, 1, 3]]), np.array([0.5, 0.25])
    for losses, v in (
        reference.histograms_distortion(*given, SCALE),
        by_kernel(any_device, "histograms_distortion", *given),
    ):
        np.testing.assert_allclose(losses, [2 * 0.125 * 1.5 + (0.25 * 1 + 0.0625 * 2) / 3], rtol=1e-6)
        expected = [2 * (0.25 * 1.5 + 0.5 / 3), 2 * (0.5 * 1.5 + 0.25 * 2 / 3)]
        np.testing.assert_allclose(v, SCALE * np.array(expected), rtol=1e-6)


@pytest.mark.parametrize("name", ["histograms_interlevel", "histograms_distortion"])
def test_matches_twin(any_device, name):
    given = histograms() if name.endswith("interlevel") else histograms()[:2]
    losses, v = getattr(reference, name)(*given, SCALE)
    assert (losses > 0).any() and (v == 0).any() == name.endswith("interlevel")
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    found = by_kernel(any_device, name, *given)
    assert_matches("losses of rays", found[0], losses, tolerances)
    assert_matches("v_weights of rays", found[1], v, tolerances)


def test_gradients_by_central_differences(device64):
    edges, weights, outer_edges, outer_weights = histograms()

    def interlevel(outer_weights):
        given = edges, weights, outer_edges, outer_weights
        return SCALE * float(by_kernel(device64, "histograms_interlevel", *given)[0].sum())

    def distortion(weights):
        return SCALE * float(by_kernel(device64, "histograms_distortion", edges, weights)[0].sum())

    v = by_kernel(device64, "histograms_interlevel", edges, weights, outer_edges, outer_weights)[1]
    gradcheck(interlevel, {"outer_weights": outer_weights}, {"outer_weights": v})
    v = by_kernel(device64, "histograms_distortion", edges, weights)[1]
    gradcheck(distortion, {"weights": weights}, {"weights": v})


def test_a_proposal_of_the_same_weights_has_no_loss(any_device):
    edges, weights = histograms()[:2]
    losses, v = by_kernel(any_device, "histograms_interlevel", edges, weights, edges, weights)
    assert not losses.any() and not v.any()
