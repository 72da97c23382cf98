"""Levels of detail: half the Gaussians each, the same masses, and an image that stays close."""

import numpy as np
import pytest
from small_run import known_scene

from clsplat.camera import Camera
from clsplat.formats.detail_tree import bounds
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr
from clsplat.pruning.levels import _costs, detail_tree, halved
from clsplat.pruning.merging import masses
from clsplat.render import render
from clsplat.testing import synthetic_scene


def surface(n: int, seed: int = 0) -> Gaussians:
    """Small discs on a plane, whose colours change in steps."""
    rng = np.random.default_rng(seed)
    gaussians = synthetic_scene(n, seed)[0].astype(np.float32)
    gaussians.means[:] = rng.uniform(-1, 1, (n, 3)) * [1, 1, 0.001] + [0, 0, 4]
    gaussians.log_scales[:] = np.log([1.2 / np.sqrt(n), 1.2 / np.sqrt(n), 0.01 / np.sqrt(n)])
    gaussians.quats[:] = [1, 0, 0, 0]
    gaussians.logit_opacities[:] = 3
    gaussians.sh[:] = 0
    gaussians.sh[:, 0] = 1.5 * np.sign(np.sin(6 * gaussians.means))
    return gaussians


def test_halves_have_the_same_masses_and_look_alike() -> None:
    gaussians = surface(1001)
    half = halved(gaussians)
    assert len(half) == 501
    quarter = halved(half)
    assert len(quarter) == 251
    for level in (half, quarter):  # single precision, and opacities close to 1 whose depth is limited
        np.testing.assert_allclose(masses(level).sum(), masses(gaussians).sum(), rtol=0.05)
    camera = Camera.look_at([0, 0, 0], [0, 0, 4], [0, -1, 0], 60, 48, 48)
    images = [render(g, camera, device="reference", gradients=False).rgb for g in (gaussians, half, quarter)]
    # Measured: 27.8 and 22.3 dB; 26.2 and 21.9 dB where pairs are taken in the order of their indices.
    assert psnr(images[1], images[0]) > 27 and psnr(images[2], images[0]) > 22
    again = halved(gaussians)
    assert all(
        a.tobytes() == b.tobytes() for a, b in zip(half.arrays().values(), again.arrays().values(), strict=True)
    )


@pytest.mark.parametrize("invisible", [100, 700, 1000])
def test_what_has_no_opacity_is_in_no_level(invisible: int) -> None:
    gaussians = surface(1000)
    gaussians.logit_opacities[:invisible] = -200
    half = halved(gaussians)
    assert len(half) == (300 if invisible == 700 else 500)
    assert all(np.isfinite(array).all() for array in half.arrays().values())


def test_what_differs_costs_more() -> None:
    gaussians = surface(5)
    gaussians.means[:] = [[0, 0, 4], [0.1, 0, 4], [0.2, 0, 4], [0.5, 0, 4], [0.6, 0, 4]]
    gaussians.sh[:, 0] = [[0, 1, 0], [0, 1, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0]]
    gaussians.log_scales[4] -= 1
    alike, colour, distance, size = _costs(gaussians, np.array([[0, 1], [1, 2], [2, 3], [3, 4]]))
    assert 0 < alike < colour and alike < distance and alike < size


@pytest.mark.parametrize(
    ("n", "leaf", "depth"), [(1000, 100, 3), (1000, 20, 3), (600, 1 << 17, 3), (70, 10, 0), (1, 5, 0)]
)
def test_every_leaf_is_in_every_level(n: int, leaf: int, depth: int) -> None:
    gaussians = surface(n)
    nodes = list(detail_tree(gaussians, leaf))
    assert (nodes[-1].height, nodes[-1].number) == (depth, 0)
    for height in range(depth + 1):
        level = [node for node in nodes if node.height == height]
        assert [node.number for node in level] == list(range(2 ** (depth - height)))
        leaves = [number for node in level for number, _ in node.leaves]
        assert leaves == list(range(2**depth))
        for node in level:
            assert sum(count for _, count in node.leaves) == len(node.gaussians)
        total = sum(len(node.gaussians) for node in level)
        assert n / 2**height <= total <= n / 2**height + 2**depth
    finest = np.concatenate([node.gaussians.means for node in nodes if node.height == 0])
    assert sorted(map(tuple, finest)) == sorted(map(tuple, gaussians.means))
    heights = [(node.height, node.number) for node in nodes]
    for height, number in heights[:-1]:
        assert heights.index((height, number)) < heights.index((height + 1, number // 2)), "children before parents"


def test_bounds_are_those_of_ellipsoids() -> None:
    gaussians = synthetic_scene(1, seed=3)[0].astype(np.float32)
    gaussians.quats *= 3  # normalised where it is used
    low, high = bounds(gaussians)
    sphere = np.random.default_rng(0).normal(size=(20_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    from clsplat.reference.project import rotations

    axes = rotations((gaussians.quats / np.linalg.norm(gaussians.quats)).astype(np.float64))[0]
    points = (sphere * gaussians.scales) @ axes.T + gaussians.means
    # 20 000 random directions come within 1 % of the farthest point.
    np.testing.assert_allclose(points.min(axis=0), low, atol=0.01 * float(gaussians.scales.max()))
    np.testing.assert_allclose(points.max(axis=0), high, atol=0.01 * float(gaussians.scales.max()))
    assert len(known_scene().train) == 12
