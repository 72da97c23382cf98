"""The network of NeRF: gradients of its weights by central differences, its widths, and its parts in float64."""

from itertools import pairwise

import numpy as np
import pytest

from clsplat import reference
from clsplat.fields.layers import VIEW_LEVELS, ViewNetwork
from clsplat.ops import Launches
from clsplat.testing import gradcheck

RAYS, PER, SCALE = 3, 4, 3.0


def given(network):
    """Weights of the parts, encoded points and directions, and gradients of the densities and the colours."""
    rng = np.random.default_rng(0)
    sizes = {name: sum(a * b for a, b in pairwise(w)) for name, w in network.widths.items()}
    weights = {name: rng.normal(size=size) / 4 for name, size in sizes.items()}
    points, directions = rng.uniform(-1, 1, (RAYS * PER, 3)), rng.normal(size=(RAYS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    encoded, views = reference.encode_points(points, 2), reference.encode_points(directions, VIEW_LEVELS)
    return weights, encoded, views, rng.normal(size=RAYS * PER), rng.normal(size=(RAYS * PER, 3))


def test_the_widths_are_those_of_the_paper():
    """Eight layers of 256, of which the sixth sees the point again (320 inputs), and a colour by one of 128."""
    widths = ViewNetwork(64, 8, 256, 256, 128).widths
    assert widths["early"] == (64, 256, 256, 256, 256, 256)
    assert widths["late"] == (320, 256, 256, 256, 256)
    assert widths["color"] == (288, 128, 16)


@pytest.mark.parametrize("depth", [2, 4])
def test_gradients_by_central_differences(device64, depth):
    network = ViewNetwork(16, depth, 16, 16, 16)
    weights, encoded, views, v_sigmas, v_colors = given(network)
    stages, up = Launches(device64), lambda a: device64.upload("array", a)
    fixed = up(encoded), up(views), SCALE

    def ask(weights):
        return network.ask(stages, {name: up(w) for name, w in weights.items()}, *fixed)

    def total(**weights):
        asked = ask(weights)
        return float(asked.sigmas.get() @ v_sigmas + (asked.colors.get() * v_colors).sum())

    on_device = {name: up(w) for name, w in weights.items()}
    found = network.gradients(stages, on_device, ask(weights), SCALE, up(v_sigmas), up(v_colors))
    gradcheck(total, weights, {name: gradient.get() for name, gradient in found.items()})


def test_matches_the_twins(device64):
    """All parts together: the same network with the float64 twins in the place of the kernels."""
    network = ViewNetwork(16, 4, 32, 16, 16)
    weights, encoded, views, v_sigmas, v_colors = given(network)
    up = lambda a: device64.upload("array", a)  # noqa: E731
    on_device = {name: up(w) for name, w in weights.items()}
    asked = network.ask(Launches(device64), on_device, up(encoded), up(views), SCALE)
    expected = network.ask(reference, weights, encoded, views, SCALE)
    np.testing.assert_allclose(asked.sigmas.get(), expected.sigmas, rtol=1e-10)  # float64 on both sides
    np.testing.assert_allclose(asked.colors.get(), expected.colors, rtol=1e-10)
    found = network.gradients(Launches(device64), on_device, asked, SCALE, up(v_sigmas), up(v_colors))
    wanted = network.gradients(reference, weights, expected, SCALE, v_sigmas, v_colors)
    for name, gradient in wanted.items():
        np.testing.assert_allclose(found[name].get(), gradient, rtol=1e-9, atol=1e-11 * np.abs(gradient).max())
