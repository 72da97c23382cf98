"""Stage noise: Philox against its published answers, the draws' distribution, the kernel against the twin."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.gaussians import Gaussians, logit, sigmoid
from clsplat.reference.noise import normals, philox
from clsplat.reference.project import rotations
from clsplat.renderer import Renderer, fetch
from clsplat.stages import GATE_OPACITY, GATE_SLOPE
from clsplat.testing import assert_matches, synthetic_scene


def scene(n):
    """Opacities on both sides of the gate; exact in single precision."""
    gaussians = synthetic_scene(n, seed=n)[0]
    gaussians.logit_opacities[:] = np.linspace(-12, 12, n)
    return gaussians.astype(np.float32).astype(np.float64)


def by_kernel(device, gaussians, *arguments):
    uploaded = Renderer(device).place(gaussians)
    ops.add_noise(device, uploaded, *arguments)
    return fetch(uploaded)


def by_twin(gaussians, *arguments):
    moved = gaussians.astype(np.float64)
    reference.add_noise(moved, *arguments)
    return moved


def test_philox_gives_the_published_numbers():
    """The known answers of Random123, the authors' library (its file kat_vectors)."""
    ones, digits_of_pi = 0xFFFFFFFF, (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344)
    for counter, key, expected in [
        ((0,) * 4, (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((ones,) * 4, (ones, ones), (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (digits_of_pi, (0xA4093822, 0x299F31D0), (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1)),
    ]:
        assert tuple(philox(np.array([counter], np.uint32), key)[0]) == expected


def test_normals_are_standard_and_independent():
    n = 100_000
    counters = np.zeros((n, 4), np.uint32)
    counters[:, 0] = np.arange(n)
    x = normals(philox(counters, (1, 2)))
    # Five standard deviations of each estimate: 1/sqrt(n) of a mean or a correlation, sqrt(2/n) of a variance,
    # sqrt(96/n) of a fourth moment.
    assert np.abs(x.mean(axis=0)).max() < 5 / np.sqrt(n)
    assert np.abs(np.cov(x.T) - np.eye(3)).max() < 5 * np.sqrt(2 / n)
    assert np.abs((x**4).mean(axis=0) - 3).max() < 5 * np.sqrt(96 / n)
    assert np.abs(np.corrcoef((x**2).T) - np.eye(3)).max() < 5 / np.sqrt(n)
    # The smallest and the largest integers are finite.
    assert np.isfinite(normals(np.array([[0] * 4, [0xFFFFFFFF] * 4], np.uint32))).all()


@pytest.mark.parametrize("n", [1, 63, 65, 1000])
def test_matches_twin(any_device, n):
    gaussians, arguments = scene(n), (3.0, 2**40 + 5, 70_000)
    found, expected = by_kernel(any_device, gaussians, *arguments), by_twin(gaussians, *arguments)
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    assert_matches("moved means", found.means, expected.means, tolerances)
    moved = np.abs(expected.means - gaussians.means).max(axis=1)
    assert moved[: max(1, n // 3)].min() > 0
    for name in ("log_scales", "quats", "logit_opacities", "sh"):
        np.testing.assert_array_equal(getattr(found, name), getattr(gaussians, name).astype(any_device.real))


def test_an_integer_is_a_size(any_device):
    found = [by_kernel(any_device, scene(9), size, 1, 1).means for size in (3, 3.0)]
    np.testing.assert_array_equal(*found)


def test_spread_is_the_squared_covariance_times_the_gate(any_device):
    """size gate Sigma eta has the covariance (size gate)^2 Sigma^2."""
    n, size, opacity = 20_000, 0.5, 0.01
    scales, quat = np.array([0.5, 0.2, 0.05]), np.array([0.5, -0.1, 0.7, 0.3])
    rows = np.zeros(n, int)
    one = Gaussians(
        np.zeros((1, 3)), np.log(scales)[None], quat[None], logit(np.array([opacity])), np.zeros((1, 1, 3))
    )
    moved = by_kernel(any_device, one.take(rows), size, 0, 1).means
    axes = rotations(quat[None] / np.linalg.norm(quat))[0]
    gate = sigmoid(-GATE_SLOPE * (opacity - GATE_OPACITY))
    # In the frame of the axes the standard deviations are size gate scales^2; five of their own deviations.
    np.testing.assert_allclose((moved @ axes).std(axis=0), size * gate * scales**2, rtol=5 / np.sqrt(2 * n))
    assert np.abs(np.corrcoef((moved @ axes).T) - np.eye(3)).max() < 5 / np.sqrt(n)
    assert np.abs(moved.mean(axis=0) / moved.std(axis=0)).max() < 5 / np.sqrt(n)


def test_each_iteration_and_seed_draws_anew(any_device):
    gaussians = scene(40)
    moves = {
        key: by_kernel(any_device, gaussians, 1.0, *key).means[:9]
        for key in [(0, 1), (0, 2), (1, 1), (2**32, 1), (0, 2**31)]
    }
    assert len({means.tobytes() for means in moves.values()}) == len(moves)
    again = by_kernel(any_device, gaussians, 1.0, 0, 1).means[:9]
    assert again.tobytes() == moves[0, 1].tobytes()


@pytest.mark.parametrize("value", [0.0, 200.0, -200.0])
def test_degenerate_gaussians_stay_finite(any_device, value):
    gaussians = scene(5).take(np.zeros(5, int))
    gaussians.quats[0] = 0
    gaussians.log_scales[1] = -abs(value)
    gaussians.logit_opacities[2] = value
    gaussians.logit_opacities[3] = -value
    for moved in (by_kernel(any_device, gaussians, 1.0, 0, 1), by_twin(gaussians, 1.0, 0, 1)):
        assert np.isfinite(moved.means).all()
        np.testing.assert_array_equal(moved.means[0], gaussians.means[0].astype(moved.means.dtype))
