"""Levels of detail: each level has half the Gaussians of the one below, merged by matched moments.

Space is cut into leaves by a kd-tree. Level 0 of a leaf are its Gaussians. The node at height h above the leaves
shows level h of all of them, so that every node has about as many Gaussians. Leaves are halved apart from each other:
memory is needed for a few leaves at a time, and for one unfinished node of each height.
"""

from collections.abc import Iterable, Iterator
from math import ceil, floor, log2
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.formats.detail_tree import Node
from clsplat.formats.ply_parts import PlyParts
from clsplat.gaussians import Gaussians
from clsplat.pruning.cutting import cut_on_disk, leaves
from clsplat.pruning.leaf_threads import in_threads
from clsplat.pruning.merging import covariances, masses, merged, neighbours

Array = NDArray[np.float64]

LEAF = 1 << 17
"""Largest number of Gaussians in a leaf: some megabytes when they are compressed, which load in a moment."""

LEVELS = 4
"""Fewest levels of a scene that is large enough for them: the coarsest one has an eighth of the Gaussians."""

COLOR = 30.0
"""Weight of a squared difference of colours, RGB in [0, 1], against nats of entropy (measured on fox_pinhole: values
between 10 and 100 differ by up to 0.5 dB in either direction, by the level)."""

HELD = 4
"""Leaves in memory at once, of a scene that is cut on the disk. Fewer are cut in more passes over the disk."""

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
    depth = _depth(len(gaussians), leaf)
    yield from _tree(leaves(gaussians, depth), depth)


def detail_tree_of_file(rows: PlyParts, folder: Path, leaf: int = LEAF) -> Iterator[Node]:
    """Make the levels of detail of a scene on the disk, in memory that does not grow with the scene.

    Parameters
    ----------
    rows : PlyParts
        Of a binary file.
    folder : Path
        Folder on a disk with room for the rows and 24 bytes for each. Nothing in it is left behind.
    leaf : int
        Largest number of Gaussians in a leaf.

    Yields
    ------
    Node
        Those that `detail_tree` yields for the whole scene.

    Raises
    ------
    InputError
        If the file cannot be read, a value is not finite, or the folder cannot hold the rows.
    """
    depth = _depth(rows.count, leaf)
    cuts = min(depth, max(0, ceil(log2(rows.count / (HELD * leaf)))))
    parts = cut_on_disk(rows, folder, cuts)
    yield from _tree((part for whole in parts for part in leaves(whole, depth - cuts)), depth)


def _depth(count: int, leaf: int) -> int:
    """Height of the tree."""
    wanted = max(LEVELS - 1, ceil(log2(max(1.0, count / leaf))))
    return max(0, min(wanted, floor(log2(max(1.0, count / FEWEST)))))


def _tree(parts: Iterable[Gaussians], depth: int) -> Iterator[Node]:
    """The nodes of a tree of leaves."""
    unfinished: list[list[Node]] = [[] for _ in range(depth + 1)]
    for number, levels in enumerate(in_threads(lambda part: _levels(part, depth), parts)):
        for height, level in enumerate(levels):
            part = Node(height, number >> height, level, [(number, len(level))])
            waiting = unfinished[height]
            waiting.append(part)
            if len(waiting) == 1 << height:
                yield _joined(waiting)
                waiting.clear()


def _levels(leaf: Gaussians, depth: int) -> list[Gaussians]:
    """The levels of a leaf, the finest first."""
    levels = [leaf]
    for _ in range(depth):
        levels.append(halved(levels[-1]))
    return levels


def _joined(parts: list[Node]) -> Node:
    """The node of parts, one per leaf."""
    gaussians = Gaussians.concatenate([part.gaussians for part in parts])
    return parts[0]._replace(gaussians=gaussians, leaves=[leaf for part in parts for leaf in part.leaves])


def halved(gaussians: Gaussians) -> Gaussians:
    """Merge pairs of neighbouring Gaussians until half are left, rounded up.

    In each round, two Gaussians are merged that are each other's cheapest partner, the cheapest pairs first. The cost
    of a pair is the growth of the mixture's entropy by Runnalls' bound (2007, "Kullback-Leibler approach to Gaussian
    mixture reduction"), weighted by mass, and `COLOR` times the squared difference of the two colours and their
    reduced mass.
    """
    target = -(-len(gaussians) // 2)
    drawn = gaussians.quats.any(axis=1) & (masses(gaussians) > 0)
    if drawn.any():  # others would be drawn once they are merged, or have no mean
        gaussians = gaussians.take(np.flatnonzero(drawn))
    while len(gaussians) > target:
        pairs = neighbours(gaussians)
        rank = np.empty(len(pairs), np.intp)
        rank[np.argsort(_costs(gaussians, pairs), kind="stable")] = np.arange(len(pairs))
        best = np.full(len(gaussians), len(pairs))
        for side in pairs.T:
            np.minimum.at(best, side, rank)
        mutual = np.flatnonzero((best[pairs] == rank[:, None]).all(axis=1))
        chosen = pairs[np.sort(mutual[np.argsort(rank[mutual])][: len(gaussians) - target])]
        alone = np.ones(len(gaussians), bool)
        alone[chosen] = False
        gaussians = Gaussians.concatenate([gaussians.take(alone), merged(gaussians, chosen)])
    return gaussians


def _costs(gaussians: Gaussians, pairs: NDArray[np.intp]) -> Array:
    """Costs (P,) of merging pairs (P, 2)."""
    i, j = pairs.T
    mass = masses(gaussians)
    total = mass[i] + mass[j]
    share = np.divide(mass[j], total, out=np.full_like(total, 0.5), where=total > 0)
    volume = gaussians.log_scales.sum(axis=1, dtype=np.float64)
    spread = [axis[j] - axis[i] for axis in gaussians.means.T.astype(np.float64)]
    matrices = covariances(gaussians)
    covariance: dict[tuple[int, int], Array] = {}
    for a, b in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        entry = np.ascontiguousarray(matrices[:, a, b])
        one = entry[i]
        covariance[a, b] = one + share * (entry[j] - one + (1 - share) * spread[a] * spread[b])
    growth = total * _half_log_determinant(covariance) - mass[i] * volume[i] - mass[j] * volume[j]
    color = SH_C0 * gaussians.sh[:, 0].astype(np.float64)
    gaps = ((color[i] - color[j]) ** 2).sum(axis=1)
    return np.asarray(growth + COLOR * gaps * mass[i] * mass[j] / np.maximum(total, np.finfo(np.float64).tiny))


def _half_log_determinant(m: dict[tuple[int, int], Array]) -> Array:
    """Half the logarithms of determinants, from the upper triangles of positive definite matrices.

    The matrices are eliminated, which keeps more digits of flat Gaussians than the expanded determinant.
    """
    tiny = np.finfo(np.float64).tiny
    first = np.maximum(m[0, 0], tiny)
    second = np.maximum(m[1, 1] - m[0, 1] ** 2 / first, tiny)
    mixed = m[1, 2] - m[0, 1] * m[0, 2] / first
    third = np.maximum(m[2, 2] - m[0, 2] ** 2 / first - mixed**2 / second, tiny)
    return np.asarray(np.log(first) + np.log(second) + np.log(third)) / 2
