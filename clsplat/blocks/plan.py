"""The plan of a training in blocks: how many there are, their photos, Gaussians and memory."""

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.blocks.partition import EVERYWHERE, MARGIN, Block, Box, cut
from clsplat.blocks.settings import COARSE_SHARE, REFINING_LENGTHS, block_config
from clsplat.blocks.survey import block_weights, chosen_photos, shown_in, survey
from clsplat.config import TrainConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.scene import Scene
from clsplat.training.memory import Footprint, bytes_text
from clsplat.training.outcome import FEWEST_GAUSSIANS

if TYPE_CHECKING:
    from scipy.sparse import csr_array

NEAR = 0.25
"""Width of the surroundings that later trainings draw as they were trained, where memory is too small for all of
them, as a fraction of the block's extent. Beyond, the coarse scene is drawn."""

ROUNDS = 4
"""Cuts after the first one, by which blocks that do not fit become alike (effect: docs/experiments/blocks.md)."""

WHOLE = 0.8
"""Fraction of a photo that a block and its margin have to fill for one visit in the block's length; other parts count
in proportion (measured: docs/experiments/blocks.md)."""

RESERVE = 1 / 10
"""Fraction of the memory's limit that a plan leaves free: trained Gaussians are not spread as the coarse ones
(effect: docs/experiments/blocks.md)."""


class Plan(NamedTuple):
    """Two cuts of a scene into blocks, whose borders differ.

    blocks: those of the first and the last training; between: those of the one in between; total: expected number of
    the scene's Gaussians, with the sky; memory: expected bytes of the largest block.
    """

    blocks: list[Block]
    between: list[Block]
    total: int
    memory: int

    def cut(self, training: int) -> list[Block]:
        """The blocks of a training, counted from 0: pixels that several blocks share in one are a block's own in the
        next.

        In the last training they have no margin. Blocks that change only what they keep, and take their share of each
        pixel's error, mend the whole error together; what a margin learned would be lost.
        """
        blocks = self.between if training % 2 else self.blocks
        return [block._replace(wide=block.box) for block in blocks] if training == len(REFINING_LENGTHS) else blocks

    def describe(self, config: TrainConfig, scene: Scene, seconds: float) -> str:
        """A sentence on blocks, photos, memory, time and size; seconds: of an iteration with photos of full size."""
        photos = [len(block.photos) for block in self.blocks]
        bytes_of = [
            sum(3 * scene.train[i].camera.width * scene.train[i].camera.height for i in block.photos)
            for block in self.blocks
        ]
        lengths = [1.0, *REFINING_LENGTHS]
        steps = round(
            sum(
                length * block_config(config, scene, block).iterations
                for training, length in enumerate(lengths)
                for block in self.cut(training)
            )
        )
        largest = max(block.gaussians for block in self.blocks)
        return (
            f"blocks: {len(self.blocks)}, each with {min(photos)} to {max(photos)} of {len(scene.train)} photos "
            f"(at most {bytes_text(max(bytes_of))}) and at most {largest} Gaussians, which take "
            f"{bytes_text(self.memory)} of the device; about {self.total} Gaussians in all, {steps} iterations, "
            f"{max(1, round(steps * seconds / 60))} minutes on one such device"
        )


def make_plan(coarse: Gaussians, scene: Scene, config: TrainConfig, renderer: Renderer, sky: int = 0) -> Plan:
    """Cut a scene into blocks and choose the photos of each.

    Parameters
    ----------
    coarse : Gaussians
        The result of the coarse run without the sky, on the host.
    scene : Scene
    config : TrainConfig
        Its `blocks` is the number of blocks, or "auto" for a number of which each fits the device's limit, while one
        block less would not.
    renderer : Renderer
        With a device.
    sky : int
        Number of Gaussians of the sky: each block draws them, and none trains them.

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
    usable = round((1 - RESERVE) * limit)
    cap, most = config.max_gaussians, max(1, len(coarse) // FEWEST_GAUSSIANS)
    total = round(len(coarse) / COARSE_SHARE) if cap is None else max(1, cap - sky)
    if config.blocks == "auto" and need.total(total + sky) <= limit:
        whole = Block(EVERYWHERE, EVERYWHERE, EVERYWHERE, np.arange(len(scene.train)), total, 0, len(scene.train))
        return Plan([whole], [whole], total + sky, need.total(total + sky))
    if config.blocks != "auto" and config.blocks > most:
        raise InputError(
            f"--blocks: expected at most {most}, as the coarse scene has {len(coarse)} Gaussians, found "
            f"{config.blocks}; use fewer blocks"
        )
    fewest = config.few.below  # with fewer, a block would need its settings for few photos
    fitting = config.blocks == "auto"
    ground = _Ground(coarse.means, survey(renderer, coarse, scene.train), total, sky, fewest, need, usable, fitting)
    if config.blocks == "auto":
        cuts = _fitting(ground, -(-total // max(1, need.most_gaussians(usable))), most)
    else:
        cuts, _ = _cuts(ground, config.blocks)
    blocks, between = ([_among_all(ground, block) for block in each] for each in cuts)
    return Plan(blocks, between, total + sky, max(_memory(block, need) for block in (*blocks, *between)))


class _Ground(NamedTuple):
    """What the cuts of a scene are made from.

    means (N, 3): of the coarse Gaussians; surveyed (V, N): their weights in the photos; total: expected Gaussians of
    the scene without the sky; sky: those of the sky; fewest: photos that a block has at least; need: memory of
    training without surroundings; limit: bytes that a block may take; fitting: whether blocks must fit, as their
    number is found by that.
    """

    means: NDArray[np.float64]
    surveyed: "csr_array"
    total: int
    sky: int
    fewest: int
    need: Footprint
    limit: int
    fitting: bool


def _fitting(ground: _Ground, least: int, most: int) -> list[list[Block]]:
    """Cut a scene into blocks that fit the memory: `least` of them, then twice as many until they fit, then as few as
    halving the last interval finds. More blocks need less memory each, with few exceptions."""
    low, high = 0, min(max(2, least), most)
    cuts, smallest = _cuts(ground, high)
    while smallest > ground.limit and high < most:
        low, high = high, min(2 * high, most)
        cuts, memory = _cuts(ground, high)
        smallest = min(smallest, memory)
    if smallest > ground.limit:
        raise InputError(
            "--memory-limit: expected one that a block fits, found "
            f"{bytes_text(round(ground.limit / (1 - RESERVE)))}, where the largest of {most} blocks takes "
            f"{bytes_text(smallest)}, and a tenth stays free; use --downscale or fewer --max-gaussians"
        )
    while high - max(low, 1) > 1:
        middle = (low + high) // 2
        fewer, memory = _cuts(ground, middle)
        if memory <= ground.limit:
            cuts, high = fewer, middle
        else:
            low = middle
    return cuts


def _cuts(ground: _Ground, count: int) -> tuple[list[list[Block]], int]:
    """Cut a scene into blocks, and again with other borders; find the bytes of the block that takes most."""
    blocks, memory = _cut(ground, count, between=False)
    if memory > ground.limit and ground.fitting:
        return [blocks], memory  # nobody needs the other cut
    between, other = _cut(ground, count, between=True)
    return [blocks, between], max(memory, other)


def _cut(ground: _Ground, count: int, between: bool) -> tuple[list[Block], int]:
    """Cut a scene into a number of blocks with their photos, and find the bytes of the one that takes most.

    The blocks have as many Gaussians each. If one of them does not fit, the cut is made again, `ROUNDS` times, with
    the memory of a block as the cost of its Gaussians: in the middle of a scene, photos show more around a block.
    """
    best: tuple[list[Block], int] | None = None
    costs = np.ones(len(ground.means))
    for _ in range(1 + ROUNDS):
        boxes = cut(ground.means, count, costs, between)
        member = np.zeros(len(costs), np.intp)
        for k, box in enumerate(boxes):
            member[box.contains(ground.means)] = k
        shares = block_weights(ground.surveyed, member, len(boxes))
        blocks = [_block(ground, box, chosen_photos(shares[:, k], ground.fewest)) for k, box in enumerate(boxes)]
        needed = np.array([_memory(block, ground.need) for block in blocks])
        if best is None or needed.max() < best[1]:
            best = blocks, int(needed.max())
        if best[1] <= ground.limit:
            break
        costs *= (needed / needed.mean())[member]
    assert best
    return best


def _block(ground: _Ground, box: Box, photos: NDArray[np.intp], everything_near: bool = False) -> Block:
    """A block with what its photos show around it."""
    wide = box.widened(ground.means, MARGIN)
    near = EVERYWHERE if everything_near else box.widened(ground.means, MARGIN + NEAR)
    trains, drawn = wide.contains(ground.means), near.contains(ground.means)
    around = shown_in(ground.surveyed, photos) & ~trains
    ratio = ground.total / len(ground.means)
    second = round(ratio * (around & drawn).sum()) + int((around & ~drawn).sum())
    backdrop = ground.sky + max(int(around.sum()), second)
    shown = ground.surveyed[photos].astype(np.float64)
    part = (shown @ trains) / np.maximum(shown.sum(axis=1), np.finfo(float).tiny)
    visits = float(part.sum() / WHOLE)
    return Block(box, wide, near, photos, max(1, round(ratio * trains.sum())), backdrop, visits)


def _among_all(ground: _Ground, block: Block) -> Block:
    """The block with all surroundings as they will have been trained, if these fit; otherwise as it is."""
    found = _block(ground, block.box, block.photos, everything_near=True)
    return found if _memory(found, ground.need) <= ground.limit else block


def _memory(block: Block, need: Footprint) -> int:
    """Bytes of the device that a block takes."""
    return replace(need, backdrop=block.backdrop).total(block.gaussians)
