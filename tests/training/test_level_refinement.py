"""Levels of detail that are refined against photos: kept where held-out photos are shown better."""

from dataclasses import replace

import numpy as np
import pytest
from small_run import CONFIG, known_scene, same

from clsplat.config import TrainConfig
from clsplat.device import Device
from clsplat.formats.detail_tree import Node
from clsplat.gaussians import Gaussians
from clsplat.scene import Scene
from clsplat.testing import synthetic_scene
from clsplat.training import level_refinement
from clsplat.training.level_refinement import refined

SETTINGS = replace(CONFIG, iterations=80)


def tree() -> list[Node]:
    """Two leaves of the known Gaussians, and a level above them with wrong colours."""
    truth = synthetic_scene(40, seed=4)[0]
    rng = np.random.default_rng(0)
    truth.means[:] = rng.uniform(-0.6, 0.6, truth.means.shape)
    truth.log_scales[:] = np.log(0.15)
    truth.logit_opacities[:] = 1.5
    truth.sh[:, 0] = rng.uniform(-1, 1.5, (40, 3))
    first, second = truth.take(np.arange(17)), truth.take(np.arange(17, 40))
    above = Gaussians.concatenate([truth.take(np.arange(9)), truth.take(np.arange(17, 29))])
    above.sh[:, 0] += 0.8
    leaves = [Node(0, 0, first, [(0, 17)]), Node(0, 1, second, [(1, 23)])]
    return [*leaves, Node(1, 0, above, [(0, 9), (1, 12)])]


def level_of(nodes: list[Node], scene: Scene, config: TrainConfig, device: Device) -> tuple[Node, list[str]]:
    said: list[str] = []
    result = refined(iter(nodes), scene, config, device, said.append)
    assert [(n.height, n.number, n.leaves) for n in result] == [(n.height, n.number, n.leaves) for n in nodes]
    assert all(same(a.gaussians, b.gaussians) for a, b in zip(result[:2], nodes[:2], strict=True)), "leaves stay"
    return result[2], said


def test_a_level_becomes_better(device: Device) -> None:
    nodes = tree()
    node, said = level_of(nodes, known_scene(), SETTINGS, device)
    before, after = (float(part.split(" dB")[0]) for part in said[0].replace("size ", "ment ").split("ment ")[1:])
    assert said[0].startswith("level 1: 21 Gaussians, held-out PSNR at half size") and "left" not in said[0]
    assert after > before + 1 and len(node.gaussians) == 21
    # The rows of a leaf are where they were: each has moved by less than the distance to most others.
    assert np.linalg.norm(node.gaussians.means - nodes[2].gaussians.means, axis=1).max() < 0.2


def test_a_level_that_does_not_become_better_is_left(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(level_refinement, "RATE", 1e4)  # Gaussians fly away
    nodes = tree()
    node, said = level_of(nodes, known_scene(), SETTINGS, device)
    assert same(node.gaussians, nodes[2].gaussians) and said[0].endswith("; left as it was")


def test_nodes_of_a_level_get_their_own_gaussians(device: Device) -> None:
    """As many nodes as leaves: each part of the trained level goes to its node."""
    leaves = [node.gaussians for node in tree()[:2]]
    nodes = [
        Node(0, 0, leaves[0], [(0, 17)]),
        Node(1, 0, leaves[0].take(np.arange(17)), [(0, 17)]),
        Node(0, 1, leaves[1], [(1, 23)]),
        Node(1, 1, leaves[1].take(np.arange(23)), [(1, 23)]),
    ]
    for node in nodes[1::2]:
        node.gaussians.sh[:, 0] += 0.5
    result = refined(nodes, known_scene(), SETTINGS, device, lambda text: None)
    for before, after in zip(nodes, result, strict=True):
        assert len(before.gaussians) == len(after.gaussians)
        assert np.linalg.norm(before.gaussians.means - after.gaussians.means, axis=1).max() < 0.2
    assert not same(result[1].gaussians, nodes[1].gaussians) and not same(result[3].gaussians, nodes[3].gaussians)
