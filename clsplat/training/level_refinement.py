"""Refinement of levels of detail against photos: a short training of each level, kept where it pays."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.formats.detail_tree import Node
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.render import renderings
from clsplat.renderer import Renderer, fetch
from clsplat.scene import Scene, View, in_turn
from clsplat.training.coarse_to_fine import shrunk
from clsplat.training.preparation import of_fixed_size
from clsplat.training.run_length import with_length
from clsplat.training.session import Training
from clsplat.training.state import initial_state

if TYPE_CHECKING:
    from clsplat.device import Device

FACTOR = 2
"""Divisor of the photos' edges: a level is shown from farther away than the scene."""

LENGTH = 1 / 4
"""Iterations of a level, as a fraction of those of the scene. A choice; others were not measured."""

RATE = 1 / 10
"""Factor on the first learning rate of the means, as in later trainings of a block: the Gaussians have their
places."""


def refined(
    nodes: Iterable[Node], scene: Scene, config: TrainConfig, device: "Device", tell: Callable[[str], None]
) -> list[Node]:
    """Train the levels of a scene on its photos at half their size, and keep those that show held-out ones better.

    Parameters
    ----------
    nodes : iterable of Node
        As `clsplat.pruning.levels.detail_tree` yields them, in the coordinates of the scene.
    scene : Scene
        With held-out photos, which decide.
    config : TrainConfig
        Settings of the run that made the scene.
    device : Device
    tell : callable
        Called with a sentence about each level.

    Returns
    -------
    list of Node
        The same nodes, in their order. All levels are in memory, which take twice the scene.
    """
    nodes = list(nodes)
    small = replace(
        scene, train=[shrunk(v, FACTOR) for v in scene.train], test=[shrunk(v, FACTOR) for v in scene.test]
    )
    config = with_length(config, scene)
    renderer = Renderer(device, config.render, BACKGROUNDS[config.data.background])
    for height in range(1, max(node.height for node in nodes) + 1):
        places = [i for i, node in enumerate(nodes) if node.height == height]
        level = Gaussians.concatenate([nodes[i].gaussians for i in places])
        trained = _trained(level, small, config, device)
        before, after = (_quality(gaussians, small.test, renderer) for gaussians in (level, trained))
        kept = after > before
        tell(
            f"level {height}: {len(level)} Gaussians, held-out PSNR at half size {before:.2f} dB, after refinement "
            f"{after:.2f} dB{'' if kept else '; left as it was'}"
        )
        parts = _parts(trained, [len(nodes[i].gaussians) for i in places])
        for i, part in zip(places, parts, strict=True) if kept else ():
            nodes[i] = nodes[i]._replace(gaussians=part)
    return nodes


def _trained(level: Gaussians, scene: Scene, config: TrainConfig, device: "Device") -> Gaussians:
    config = replace(
        of_fixed_size(config, len(level), RATE),
        iterations=max(1, round(LENGTH * config.iterations)),
        exposure=False,  # the scene has the mean colours of the photos, as the held-out ones do
        response=False,
        poses=False,
        filter_3d=False,  # the saved scene contains it
        dropout=0.0,
    )
    training = Training(scene, config, device, initial_state(scene, config, level))
    training.run_until(config.iterations, lambda _, loss: None)
    return fetch(training.state.gaussians)


def _quality(gaussians: Gaussians, views: list[View], renderer: Renderer) -> float:
    """Mean PSNR, dB."""
    pairs = zip(renderings(renderer, gaussians, [view.camera for view in views]), in_turn(views), strict=True)
    return float(np.mean([psnr(to_uint8(rendering.rgb), view.image, view.mask) for rendering, view in pairs]))


def _parts(gaussians: Gaussians, counts: list[int]) -> Iterator[Gaussians]:
    """Consecutive parts of Gaussians."""
    for end, count in zip(np.cumsum(counts), counts, strict=True):
        yield gaussians.take(np.arange(end - count, end))
