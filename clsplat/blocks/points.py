"""Gaussians at the sparse points of a block, beside those of the coarse run."""

import numpy as np
from numpy.typing import NDArray

from clsplat.blocks.partition import Block
from clsplat.config import TrainConfig
from clsplat.gaussians import Gaussians
from clsplat.randomness import stream
from clsplat.scene import Scene
from clsplat.training.initialize import from_points
from clsplat.training.state import start_config


def sparse_start(scene: Scene, means: NDArray[np.float64], block: Block, config: TrainConfig) -> Gaussians | None:
    """Make Gaussians at a block's sparse points, as a training that is not in blocks starts with.

    The coarse run has trained without the details that it could not show. Growth finds them again more slowly than
    sparse points mark them (effect: docs/experiments/blocks.md).

    Parameters
    ----------
    scene : Scene
        With its sparse points.
    means : (N, 3)
        Means of the coarse Gaussians.
    block : Block
    config : TrainConfig
        Of the run.

    Returns
    -------
    Gaussians or None
        At points in the block and its margin: together with the coarse ones there, at most as many as the block is
        expected to have. None if there is no room or no point.
    """
    inside = np.flatnonzero(block.wide.contains(scene.points))
    room = block.gaussians - int(block.wide.contains(means).sum())
    if room <= 0 or not len(inside):
        return None
    order = stream(config.seed, "points of blocks").permutation(len(scene.points))
    rows = inside[np.sort(np.argsort(order[inside], kind="stable")[:room])]
    return from_points(scene.points[rows], scene.colors[rows], start_config(config))
