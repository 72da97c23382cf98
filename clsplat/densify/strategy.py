"""What a densification strategy is."""

from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

from clsplat.config import TrainConfig
from clsplat.gaussians import Gaussians

Array = NDArray[Any]


class Edit(NamedTuple):
    """New rows for old ones.

    gaussians: after the edit; rows (M,): the old row that each new one continues; fresh (M,) bool: whether the
    optimiser's moments of a new row start at 0; reset_opacities: whether those of all logits of opacities do.
    """

    gaussians: Gaussians
    rows: Array
    fresh: Array
    reset_opacities: bool = False


class Strategy(Protocol):
    """Decides when Gaussians are added and removed, from statistics of the gradients.

    A strategy keeps all it remembers between iterations in `statistics`, arrays of one row per Gaussian: checkpoints
    save and restore them, so that a resumed run continues to the same bits. No edit leaves more than `max_gaussians`,
    which training lowers to what fits the device.
    """

    statistics: dict[str, Any]
    max_gaussians: int

    def __init__(self, config: TrainConfig, extent: float, n: int) -> None:
        """Statistics of `n` Gaussians in a scene of the given extent, in world units."""

    def watches(self, iteration: int) -> bool:
        """Whether `observe` is to be told of an iteration, counted from 1."""

    def observe(self, stage: Any, extents: Any, v_means2d: Any, width: int, height: int) -> None:
        """Take in one iteration.

        Parameters
        ----------
        stage : namespace
            The stage functions that work where the arrays and the statistics lie: `clsplat.render.stage_functions`.
        extents, v_means2d : (N, 2)
            Of the splats, and the gradients with respect to their centres, per pixel.
        width, height : int
            The image's size in pixels.
        """

    def due(self, iteration: int) -> bool:
        """Whether an edit is due after an iteration, counted from 1."""

    def edit(self, iteration: int, gaussians: Gaussians) -> Edit:
        """The edit that is due.

        Leaves `gaussians` as they are, and the statistics in step with the result."""
