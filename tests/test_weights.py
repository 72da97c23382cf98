"""Stage weights: a medium in closed form, against the twin and central differences."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.testing import assert_matches, gradcheck

COUNT = 24


def samples(rays=37, density=3.0):
    rng = np.random.default_rng(0)
    arrays = density * rng.uniform(size=rays * COUNT) ** 2, rng.uniform(0.01, 0.1, rays * COUNT)
    arrays += rng.normal(size=rays * COUNT), rng.normal(size=rays * COUNT)
    return [a.astype(np.float32).astype(np.float64) for a in arrays]


def by_kernel(device, sigmas, deltas, v_weights, v_sigmas):
    arrays = [device.upload("array", a) for a in (sigmas, deltas, v_weights, v_sigmas)]
    weights = ops.weights_fwd(device, *arrays[:2], COUNT)
    ops.weights_bwd(device, *arrays[:2], COUNT, weights, *arrays[2:])
    return weights.get(), arrays[3].get()


def by_twin(sigmas, deltas, v_weights, v_sigmas):
    weights, v_sigmas = reference.weights_fwd(sigmas, deltas, COUNT), v_sigmas.copy()
    reference.weights_bwd(sigmas, deltas, COUNT, weights, v_weights, v_sigmas)
    return weights, v_sigmas


def test_a_homogeneous_medium_has_its_closed_form(any_device):
    """Weights of equal segments are a geometric sequence; with what is behind they add up to 1."""
    given = np.full(COUNT, 2.0), np.full(COUNT, 0.05), np.zeros(COUNT), np.zeros(COUNT)
    expected = (1 - np.exp(-0.1)) * np.exp(-0.1 * np.arange(COUNT))
    for run in (by_twin, lambda *a: by_kernel(any_device, *a)):
        np.testing.assert_allclose(run(*given)[0], expected, rtol=1e-5)  # float32: sums of depths


@pytest.mark.parametrize("density", [3.0, 300.0], ids=["thin", "opaque"])
def test_matches_twin(any_device, density):
    given = samples(density=density)
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    found, expected = by_kernel(any_device, *given), by_twin(*given)
    for name, array, wanted in zip(("sample weights", "v_sigmas"), found, expected, strict=True):
        assert_matches(name, array, wanted, tolerances)


def test_weights_are_those_of_the_colours(device64):
    """The stage rays with these densities has the colour that the weights give, on black."""
    sigmas, deltas, *_ = samples(rays=9)
    colors = np.random.default_rng(1).uniform(size=(9 * COUNT, 3))
    first = np.arange(0, 9 * COUNT + 1, COUNT, dtype=np.uint32)
    weights = reference.weights_fwd(sigmas, deltas, COUNT)
    expected = (weights[:, None] * colors).reshape(9, COUNT, 3).sum(axis=1)
    np.testing.assert_allclose(reference.rays_fwd(sigmas, colors, deltas, first, (0, 0, 0)).rgb, expected, rtol=1e-12)


def test_gradients_by_central_differences(device64):
    sigmas, deltas, v_weights, _ = samples(rays=5)
    v_sigmas = by_kernel(device64, sigmas, deltas, v_weights, 0 * sigmas)[1]

    def total(sigmas):
        return float(by_kernel(device64, sigmas, deltas, v_weights, 0 * sigmas)[0] @ v_weights)

    gradcheck(total, {"sigmas": sigmas}, {"sigmas": v_sigmas})


def test_an_opaque_sample_hides_all_others(any_device):
    """Its depth is so large that adding those before it, and subtracting it again, would leave nothing of them."""
    given = np.full(COUNT, 2.0), np.full(COUNT, 0.05), np.ones(COUNT), np.zeros(COUNT)
    given[0][5] = 1e25
    for run in (by_twin, lambda *a: by_kernel(any_device, *a)):
        weights = run(*given)[0]
        np.testing.assert_allclose(weights[5], np.exp(-0.5), rtol=1e-5)
        assert weights.sum() == pytest.approx(1, rel=1e-5) and not weights[6:].any()
