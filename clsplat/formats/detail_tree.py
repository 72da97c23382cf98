"""A scene in levels of detail as its writers take it: a binary tree of nodes, each with one level of its leaves."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians
from clsplat.reference.project import rotations

Array = NDArray[Any]


class Node(NamedTuple):
    """A node of the tree.

    height: 0 for a leaf, and its level of detail, 0 being the finest; number: that of the node among those of its
    height, from left to right: its children are the nodes 2 number and 2 number + 1 of the height below; gaussians:
    the level of all of its leaves; leaves: the number of each leaf and of its Gaussians, in their order.
    """

    height: int
    number: int
    gaussians: Gaussians
    leaves: list[tuple[int, int]]


def bounds(gaussians: Gaussians) -> tuple[Array, Array]:
    """Corners (3,) of the box around the Gaussians' ellipsoids of one standard deviation, world units."""
    quats = gaussians.quats.astype(np.float64)
    axes = rotations(quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12))
    half = np.sqrt(((axes * gaussians.scales.astype(np.float64)[:, None, :]) ** 2).sum(axis=2))
    return (gaussians.means - half).min(axis=0), (gaussians.means + half).max(axis=0)
