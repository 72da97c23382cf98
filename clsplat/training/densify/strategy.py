"""What a densification strategy is."""

from collections.abc import Callable
from typing import Any, NamedTuple

from numpy.typing import NDArray

from clsplat.config import TrainConfig
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

# Indices on the device are of 32 bits.
MOST_GAUSSIANS = 2**32 - 1


class Contributions(NamedTuple):
    """What N Gaussians have to do with some photos, added up over them.

    weights (N,): with which they are composited; errors (N,): the same, times the pixels' squared errors; prices
    (N,): by how much the squared error would rise without the Gaussian alone, negative where it does harm. Squared
    errors are summed over RGB. share: of the training photos, how many these are.
    """

    weights: Array
    errors: Array
    prices: Array
    share: float = 1.0


# Contributions to so many training photos.
Survey = Callable[[int], Contributions]


class Edit(NamedTuple):
    """New rows for old ones.

    gaussians: after the edit; rows (M,): the old row that each new one continues; fresh (M,) bool: whether the
    optimiser's moments of a new row start at 0; reset_opacities: whether those of all logits of opacities do.
    """

    gaussians: Gaussians
    rows: Array
    fresh: Array
    reset_opacities: bool = False


class Strategy:
    """Decides when Gaussians are added and removed, from statistics of the gradients; this one leaves them alone.

    A strategy keeps all it remembers between iterations in `statistics`, arrays of one row per Gaussian: checkpoints
    save and restore them, so that a resumed run continues to the same bits. No edit leaves more than `max_gaussians`:
    training sets it before each, to the user's cap or what fits the device.
    """

    statistics: dict[str, Any]
    max_gaussians: int
    start_opacity = 0.1
    """Opacity of the Gaussians at the start, where the user gives none (original)."""

    def __init__(self, config: TrainConfig, extent: float, n: int) -> None:
        """Statistics of `n` Gaussians in a scene of the given extent, in world units."""
        self.statistics = {}
        self.max_gaussians = config.max_gaussians or MOST_GAUSSIANS

    def watches(self, iteration: int) -> bool:
        """Whether `observe` is to be told of an iteration, counted from 1."""
        return False

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

    def penalties(self, n: int) -> tuple[float, float]:
        """Weights in the loss of the sum of all opacities and of that of all scales, where there are n Gaussians."""
        return 0.0, 0.0

    def perturb(self, stage: Any, gaussians: Gaussians, iteration: int, rate: float) -> None:
        """Change the Gaussians in place after the step of the optimiser.

        Parameters
        ----------
        stage : namespace
            As given to `observe`.
        gaussians : Gaussians
            Arrays where the stages work.
        iteration : int
            Counted from 1.
        rate : float
            Learning rate of the means in this iteration, in world units.
        """

    def due(self, iteration: int) -> bool:
        """Whether an edit is due after an iteration, counted from 1."""
        return False

    def edit(self, iteration: int, gaussians: Gaussians, survey: Survey) -> Edit:
        """The edit that is due.

        Leaves `gaussians` as they are, and the statistics in step with the result. `survey` renders as many photos
        as it is asked for.
        """
        raise NotImplementedError
