"""The settings of a training in blocks: of the coarse run, and of the trainings of a block."""

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from clsplat.blocks.partition import Block
from clsplat.config import CoarseConfig, TrainConfig
from clsplat.errors import InputError
from clsplat.scene import Scene
from clsplat.training.autosize.rule import full_size
from clsplat.training.memory import Footprint
from clsplat.training.preparation import of_fixed_size
from clsplat.training.run_length import with_length

if TYPE_CHECKING:
    from clsplat.device import Device

COARSE_FACTOR: Literal[2] = 2
"""Divisor of the photos' edges in the coarse run."""

COARSE_LENGTH = 1 / 3
"""Iterations of the coarse run, as a fraction of those of the whole training. Longer runs of many photos are not
better (measured: docs/experiments/blocks.md)."""

COARSE_FEWEST = 1500
"""Fewest iterations of the coarse run, unless the whole training has fewer. Much shorter runs end in a haze, whatever
the number of photos (measured: docs/experiments/blocks.md)."""

COARSE_SHARE = 1 / COARSE_FACTOR**2
"""Gaussians of the coarse run, as a fraction of those of the whole scene: as many per pixel."""

REFINING_LENGTHS = 1 / 2, 1
"""Iterations of the trainings of a block among the trained ones, as fractions of those of its first one (measured:
docs/experiments/blocks.md)."""

REFINING_MEANS = 1 / 10
"""Factor on the first learning rate of the means in these trainings. It becomes that of the middle of a training,
in which the rate falls by a factor of 100."""

REFINING_RATES = 1 / 2
"""Factor on the other learning rates in these trainings (measured: docs/experiments/blocks.md)."""

COARSE_MEMORY = 1 / 2
"""Fraction of the memory's limit that the Gaussians of the coarse run may take. With less, they are larger, and
photos belong to more blocks (effect: docs/experiments/blocks.md)."""


def check_blocks(config: TrainConfig) -> None:
    """Raise an InputError if the configuration cannot train blocks."""
    for name in ("exposure", "poses"):
        if getattr(config, name):
            raise InputError(
                f"--{name}: expected a training without --blocks, found both: each block would learn its own values "
                "for the same photo; leave out one of them"
            )
    if config.filter_3d:
        raise InputError(
            "--filter-3d: expected a training without --blocks, found both: a block trains several times, and each "
            "training would widen its Gaussians again; leave out one of them"
        )


def one_fits(scene: Scene, config: TrainConfig, device: "Device") -> bool:
    """Whether blocks are not needed, as far as this is known before the coarse run."""
    if config.blocks != "auto" or config.max_gaussians is None:
        return config.blocks == 1
    return Footprint.of(scene, config, device).total(config.max_gaussians) <= device.memory_limit


def coarse_config(config: TrainConfig, scene: Scene, device: "Device") -> TrainConfig:
    """The configuration of the run over all photos from which blocks are cut.

    It has at least `COARSE_FEWEST` iterations, or those of the whole training if these are fewer. Blocks correct the
    errors of the coarse scene only by their share of a pixel: haze of a short run would remain.
    """
    most = Footprint.of(scene, config, device).most_gaussians(round(COARSE_MEMORY * device.memory_limit))
    wanted = most if config.max_gaussians is None else max(1, round(COARSE_SHARE * config.max_gaussians))
    return replace(
        config,
        blocks=1,
        iterations=min(config.iterations, max(COARSE_FEWEST, round(COARSE_LENGTH * config.iterations))),
        max_gaussians=max(1, min(most, wanted)),
        coarse=CoarseConfig(factor=COARSE_FACTOR, until=1.0),
        eval_every=0,
    )


def block_config(config: TrainConfig, scene: Scene, block: Block) -> TrainConfig:
    """The configuration of a block.

    It trains for as many iterations as its photos alone would, counted by the part of them that it fills, and at most
    those of the whole configuration. All bands of its harmonics train from the first iterations on. Its size is not
    searched: the coarse run has seen the photos that would be held back (measured: docs/experiments/blocks.md). What
    moves has been found by the coarse run, which has all photos.
    """
    photos = max(1, round(block.visits))
    largest = max((scene.train[i] for i in block.photos), key=lambda view: view.camera.width * view.camera.height)
    alone = with_length(replace(config, iterations=0), replace(scene, train=[largest] * photos)).iterations
    return replace(
        config,
        blocks=1,
        iterations=min(config.iterations, max(alone, round(config.iterations * photos / len(scene.train)))),
        size="fixed",
        max_gaussians=_most_of(config, scene, block),
        optim=replace(config.optim, sh_degree_every=1),
        coarse=CoarseConfig(factor=1),
        mask_moving=False,
        eval_every=0,
    )


def _most_of(config: TrainConfig, scene: Scene, block: Block) -> int | None:
    """Most Gaussians of a block: those that are expected, but no more than a search would let it grow to."""
    if config.size == "fixed":
        return None if config.max_gaussians is None else block.gaussians
    points = int(block.wide.contains(scene.points).sum()) if len(scene.points) else block.gaussians
    alone = replace(scene, train=[scene.train[i] for i in block.photos])
    return max(1, min(block.gaussians, round(full_size(alone, points, config))))


def refining_config(config: TrainConfig, scene: Scene, block: Block, gaussians: int, length: float) -> TrainConfig:
    """The configuration of a block's training among the trained blocks; gaussians: number that the block has; length:
    its iterations, as a fraction of those of the first training."""
    first = block_config(config, scene, block)
    iterations = max(1, round(length * first.iterations))
    made = of_fixed_size(first, gaussians, REFINING_MEANS)
    names = ("log_scales_lr", "quats_lr", "logit_opacities_lr", "sh0_lr", "sh_rest_lr")
    rates = {name: REFINING_RATES * getattr(made.optim, name) for name in names}
    return replace(made, iterations=iterations, optim=replace(made.optim, **rates))
