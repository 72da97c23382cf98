"""The numbers of a training in blocks: the coarse run, how many blocks, their photos, Gaussians and memory."""

from dataclasses import replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.blocks.partition import EVERYWHERE, MARGIN, Box, cut
from clsplat.blocks.survey import block_weights, chosen_photos
from clsplat.config import CoarseConfig, TrainConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.scene import Scene
from clsplat.training.autosize.validation import FEWEST_PHOTOS
from clsplat.training.memory import Footprint, bytes_text
from clsplat.training.outcome import FEWEST_GAUSSIANS
from clsplat.training.preparation import of_fixed_size
from clsplat.training.run_length import with_length

if TYPE_CHECKING:
    from clsplat.device import Device

COARSE_FACTOR: Literal[2] = 2
"""Divisor of the photos' edges in the coarse run."""

COARSE_LENGTH = 1 / 3
"""Iterations of the coarse run, as a fraction of those that the configuration has."""

COARSE_SHARE = 1 / COARSE_FACTOR**2
"""Gaussians of the coarse run, as a fraction of those of the whole scene: as many per pixel."""

REFINING_LENGTH = 1 / 2
"""Iterations of a block's second training, among the trained blocks, as a fraction of those of its first one."""

REFINING_RATE = 1 / 10
"""Factor on the first learning rate of the means in the second training. It becomes that of the middle of a training,
in which the rate falls by a factor of 100."""

NEAR = 0.25
"""Width of the surroundings that the second training draws as they were trained, where memory is too small for all of
them, as a fraction of the block's extent. Beyond, the coarse scene is drawn."""

COARSE_MEMORY = 1 / 4
"""Fraction of the memory's limit that the Gaussians of the coarse run may take: each block draws them too."""


class Block(NamedTuple):
    """A part of the scene.

    box: what it keeps; wide: what it trains, with the margin; near: what its second training draws as it was trained;
    photos: indices of training photos; gaussians: expected number, margin included; backdrop: expected Gaussians
    around it in either training.
    """

    box: Box
    wide: Box
    near: Box
    photos: NDArray[np.intp]
    gaussians: int
    backdrop: int


class Plan(NamedTuple):
    """The blocks of a scene; total: expected number of its Gaussians; memory: expected bytes of the largest block."""

    blocks: list[Block]
    total: int
    memory: int

    def describe(self, config: TrainConfig, scene: Scene, seconds: float) -> str:
        """A sentence on blocks, photos, memory, time and size; seconds: of an iteration with photos of full size."""
        photos = [len(block.photos) for block in self.blocks]
        bytes_of = [
            sum(3 * scene.train[i].camera.width * scene.train[i].camera.height for i in block.photos)
            for block in self.blocks
        ]
        steps = sum(block_config(config, scene, block).iterations for block in self.blocks)
        steps += round(REFINING_LENGTH * steps)
        largest = max(block.gaussians for block in self.blocks)
        return (
            f"blocks: {len(self.blocks)}, each with {min(photos)} to {max(photos)} of {len(scene.train)} photos "
            f"(at most {bytes_text(max(bytes_of))}) and at most {largest} Gaussians, which take "
            f"{bytes_text(self.memory)} of the device; about {self.total} Gaussians in all, {steps} iterations, "
            f"{max(1, round(steps * seconds / 60))} minutes on one such device"
        )


def check_blocks(config: TrainConfig) -> None:
    """Raise an InputError if the configuration cannot train blocks."""
    for name in ("exposure", "poses"):
        if getattr(config, name):
            raise InputError(
                f"--{name}: expected a training without --blocks, found both: each block would learn its own values "
                "for the same photo; leave out one of them"
            )


def one_fits(scene: Scene, config: TrainConfig, device: "Device") -> bool:
    """Whether blocks are not needed, as far as this is known before the coarse run."""
    if config.blocks != "auto" or config.max_gaussians is None:
        return config.blocks == 1
    return Footprint.of(scene, config, device).total(config.max_gaussians) <= device.memory_limit


def coarse_config(config: TrainConfig, scene: Scene, device: "Device") -> TrainConfig:
    """The configuration of the run over all photos from which blocks are cut."""
    most = Footprint.of(scene, config, device).most_gaussians(round(COARSE_MEMORY * device.memory_limit))
    wanted = most if config.max_gaussians is None else max(1, round(COARSE_SHARE * config.max_gaussians))
    return replace(
        config,
        blocks=1,
        iterations=max(1, round(COARSE_LENGTH * config.iterations)),
        max_gaussians=max(1, min(most, wanted)),
        coarse=CoarseConfig(factor=COARSE_FACTOR, until=1.0),
        eval_every=0,
    )


def block_config(config: TrainConfig, scene: Scene, block: Block) -> TrainConfig:
    """The configuration of a block.

    It trains for as many iterations as its photos alone would, at most those of the whole configuration. Its first
    Gaussians have been trained, so that all bands of their spherical harmonics train from the start, and photos have
    their full size.
    """
    photos = len(block.photos)
    alone = with_length(replace(config, iterations=0), replace(scene, train=scene.train[:photos])).iterations
    visits = round(config.iterations * photos / len(scene.train))
    return replace(
        config,
        blocks=1,
        iterations=min(config.iterations, max(alone, visits)),
        max_gaussians=None if config.max_gaussians is None else block.gaussians,
        optim=replace(config.optim, sh_degree_every=1),
        coarse=CoarseConfig(factor=1),
        eval_every=0,
    )


def refining_config(config: TrainConfig, gaussians: int) -> TrainConfig:
    """The configuration of a block's second training, of the Gaussians that it has."""
    iterations = max(1, round(REFINING_LENGTH * config.iterations))
    return replace(of_fixed_size(config, gaussians, REFINING_RATE), iterations=iterations)


def expected_total(config: TrainConfig, coarse: int) -> int:
    """Expected number of Gaussians of the whole scene, by the configuration or by those of the coarse run."""
    return round(coarse / COARSE_SHARE) if config.max_gaussians is None else config.max_gaussians


def make_plan(coarse: Gaussians, scene: Scene, config: TrainConfig, renderer: Renderer) -> Plan:
    """Cut a scene into blocks and choose the photos of each.

    Parameters
    ----------
    coarse : Gaussians
        The result of the coarse run, on the host.
    scene : Scene
    config : TrainConfig
        Its `blocks` is the number of blocks, or "auto" for the fewest of which each fits the device's limit.
    renderer : Renderer
        With a device.

    Returns
    -------
    Plan
        With a single block of all photos if one fits.

    Raises
    ------
    InputError
        If there are more blocks than the coarse scene can be cut into, or no number of blocks fits the memory.
    """
    assert renderer.device
    need, limit = Footprint.of(scene, config, renderer.device), renderer.device.memory_limit
    most = max(1, len(coarse) // FEWEST_GAUSSIANS)
    if config.blocks == "auto":
        least = -(-expected_total(config, len(coarse)) // max(1, need.most_gaussians(limit)))
        for count in range(min(least, most), most + 1):
            blocks = _cut(coarse, count, config)
            memory = _memory(blocks, need)
            if memory <= limit:
                break
        else:
            raise InputError(
                f"--memory-limit: expected one that a block fits, found {bytes_text(limit)}, where the smallest of "
                f"{most} blocks takes {bytes_text(memory)}; use --downscale or fewer --max-gaussians"
            )
    else:
        count = config.blocks
        if count > most:
            raise InputError(
                f"--blocks: expected at most {most}, as the coarse scene has {len(coarse)} Gaussians, found {count}; "
                "use fewer blocks"
            )
        blocks = _cut(coarse, count, config)
        memory = _memory(blocks, need)
    among_all = _cut(coarse, count, config, everything_near=True)
    if _memory(among_all, need) <= limit:
        blocks, memory = among_all, _memory(among_all, need)
    total = expected_total(config, len(coarse))
    return Plan(_with_photos(blocks, coarse, scene, config, renderer), total, memory)


def _cut(coarse: Gaussians, count: int, config: TrainConfig, everything_near: bool = False) -> list[Block]:
    means, total = coarse.means, expected_total(config, len(coarse))
    blocks = []
    for box in cut(means, count):
        wide = box.widened(means, MARGIN)
        near = EVERYWHERE if everything_near else box.widened(means, MARGIN + NEAR)
        trains, drawn = (wide.contains(means), near.contains(means))
        size = max(1, round(total * trains.mean()))
        backdrop = round(total * (drawn & ~trains).mean()) + int((~drawn).sum())
        blocks.append(Block(box, wide, near, np.zeros(0, np.intp), size, max(backdrop, int((~trains).sum()))))
    return blocks


def _memory(blocks: list[Block], need: Footprint) -> int:
    """Bytes of the block that takes most."""
    return max(replace(need, backdrop=block.backdrop).total(block.gaussians) for block in blocks)


def _with_photos(
    blocks: list[Block], coarse: Gaussians, scene: Scene, config: TrainConfig, renderer: Renderer
) -> list[Block]:
    """Choose the photos of blocks by a survey of all."""
    if len(blocks) == 1:
        return [blocks[0]._replace(photos=np.arange(len(scene.train)))]
    inside = np.array([block.box.contains(coarse.means) for block in blocks]).argmax(axis=0)
    shares = block_weights(renderer, coarse, scene.train, inside, len(blocks))
    fewest = max(config.few.below, FEWEST_PHOTOS)  # so that a block may search its size
    return [block._replace(photos=chosen_photos(shares[:, k], fewest)) for k, block in enumerate(blocks)]
