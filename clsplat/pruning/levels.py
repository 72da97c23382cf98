"""Levels of detail: each level has half the Gaussians of the one below, merged by matched moments.

Space is cut into leaves by a kd-tree. Level 0 of a leaf are its Gaussians. The node at height h above the leaves
shows level h of all of them, so that every node has about as many Gaussians. Leaves are halved apart from each other:
memory is needed for one leaf at a time, and for one unfinished node of each height.
"""

from collections.abc import Iterator
from math import ceil, floor, log2

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.formats.detail_tree import Node
from clsplat.gaussians import Gaussians
from clsplat.pruning.merging import masses, merged, neighbours

Array = NDArray[np.float64]

LEAF = 1 << 17
"""Largest number of Gaussians in a leaf: some megabytes when they are compressed, which load in a moment."""

LEVELS = 4
"""Fewest levels of a scene that is large enough for them: the coarsest one has an eighth of the Gaussians."""

COLOR = 30.0
"""Weight of a squared difference of colours, RGB in [0, 1], against nats of entropy (measured on fox_pinhole: values
between 10 and 100 differ by up to 0.5 dB in either direction, by the level)."""

FEWEST = 64
"""Fewest Gaussians of a leaf, on average."""


def detail_tree(gaussians: Gaussians, leaf: int = LEAF) -> Iterator[Node]:
    """Make the levels of detail of a scene.

    Parameters
    ----------
    gaussians : Gaussians
        At least one, on the host.
    leaf : int
        Largest number of Gaussians in a leaf.

    Yields
    ------
    Node
        Each before its parent, the root last.
    """
    wanted = max(LEVELS - 1, ceil(log2(max(1.0, len(gaussians) / leaf))))
    depth = max(0, min(wanted, floor(log2(max(1.0, len(gaussians) / FEWEST)))))
    unfinished: list[list[Node]] = [[] for _ in range(depth + 1)]
    for number, rows in enumerate(_leaves(gaussians.means, np.arange(len(gaussians)), depth)):
        level = gaussians.take(rows)
        for height in range(depth + 1):
            part = Node(height, number >> height, level, [(number, len(level))])
            waiting = unfinished[height]
            waiting.append(part)
            if len(waiting) == 1 << height:
                yield _joined(waiting)
                waiting.clear()
            if height < depth:
                level = halved(level)


def _joined(parts: list[Node]) -> Node:
    """The node of parts, one per leaf."""
    gaussians = Gaussians.concatenate([part.gaussians for part in parts])
    return parts[0]._replace(gaussians=gaussians, leaves=[leaf for part in parts for leaf in part.leaves])


def _leaves(means: NDArray[np.float32], rows: NDArray[np.intp], depth: int) -> Iterator[NDArray[np.intp]]:
    """Rows of the leaves of a kd-tree, cut at medians across the axis of the largest spread."""
    if depth == 0:
        yield rows
        return
    low, high = np.quantile(means[rows], (0.05, 0.95), axis=0)  # single Gaussians lie far from the others
    axis = int((high - low).argmax())
    order = rows[np.argsort(means[rows, axis], kind="stable")]
    half = len(order) // 2
    for part in (order[:half], order[half:]):
        yield from _leaves(means, np.sort(part), depth - 1)


def halved(gaussians: Gaussians) -> Gaussians:
    """Merge pairs of neighbouring Gaussians until half are left, rounded up.

    In each round, two Gaussians are merged that are each other's cheapest partner, the cheapest pairs first. The cost
    of a pair is the growth of the mixture's entropy by Runnalls' bound (2007, "Kullback-Leibler approach to Gaussian
    mixture reduction"), weighted by mass, and `COLOR` times the squared difference of the two colours and their
    reduced mass.
    """
    target = -(-len(gaussians) // 2)
    while len(gaussians) > target:
        pairs = neighbours(gaussians)
        costs, candidates = _costs(gaussians, pairs)
        rank = np.empty(len(pairs), np.intp)
        rank[np.argsort(costs, kind="stable")] = np.arange(len(pairs))
        best = np.full(len(gaussians), len(pairs))
        for side in pairs.T:
            np.minimum.at(best, side, rank)
        mutual = np.flatnonzero((best[pairs] == rank[:, None]).all(axis=1))
        chosen = np.sort(mutual[np.argsort(rank[mutual])][: len(gaussians) - target])
        alone = np.ones(len(gaussians), bool)
        alone[pairs[chosen]] = False
        gaussians = Gaussians.concatenate([gaussians.take(alone), candidates.take(chosen)])
    return gaussians


def _costs(gaussians: Gaussians, pairs: NDArray[np.intp]) -> tuple[Array, Gaussians]:
    """Costs of merging pairs (P, 2), and the merged Gaussians."""
    both, mass = merged(gaussians, pairs), masses(gaussians)[pairs]
    total = mass.sum(axis=1)
    volume = gaussians.log_scales.sum(axis=1, dtype=np.float64)[pairs]
    growth = total * both.log_scales.sum(axis=1, dtype=np.float64) - (mass * volume).sum(axis=1)
    color = SH_C0 * gaussians.sh[:, 0].astype(np.float64)
    gaps = ((color[pairs[:, 0]] - color[pairs[:, 1]]) ** 2).sum(axis=1)
    return growth + COLOR * gaps * mass.prod(axis=1) / np.maximum(total, np.finfo(np.float64).tiny), both
