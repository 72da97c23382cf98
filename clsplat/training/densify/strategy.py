"""The interface of a densification strategy."""

from collections.abc import Callable
from copy import copy
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config import UINT32_MAX, TrainConfig
from clsplat.gaussians import Gaussians
from clsplat.renderer import download
from clsplat.stages import Stages
from clsplat.training.initialize import OPACITY

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[Any]

MOST_GAUSSIANS = UINT32_MAX
"""Largest number of Gaussians: indices on the device have 32 bits."""


class Contributions(NamedTuple):
    """Contributions of N Gaussians to some photos, summed over them.

    weights (N,): sums of the compositing weights; errors (N,): sums of weight times the pixel's squared error; prices
    (N,): change of the squared error if the Gaussian alone is removed, negative if the error falls; differences (N,):
    squared difference that this makes to the images; pairs (N,): pixels in which the Gaussian is composited. Squares
    are summed over RGB. photos: number of the training photos, of which these are some.
    """

    weights: Array
    errors: Array
    prices: Array
    differences: Array
    pairs: Array
    photos: int = 1


Survey = Callable[[int, float], Contributions]
"""Return the contributions to a number of training photos, or to a fraction of them if this is more."""


class Edit(NamedTuple):
    """New rows in exchange for old ones.

    gaussians: the M rows after the edit, without their spherical harmonics, which are those of the old rows; rows
    (M,): the old row that each new one continues; fresh (M,) bool: whether the optimiser's moments of a new row start
    at 0; reset_opacities: whether the moments of all opacities do.
    """

    gaussians: Gaussians
    rows: Array
    fresh: Array
    reset_opacities: bool = False


class Strategy:
    """Decide when and where Gaussians are added and removed; this base class never changes them.

    A strategy keeps what it remembers between iterations in `statistics`, arrays with one row per Gaussian. It alone
    changes them. Checkpoints save and restore them, so that a resumed run ends with the same bits.

    Parameters
    ----------
    config : TrainConfig
    extent : float
        Scale of the scene, world units.
    n : int
        Number of Gaussians.
    """

    start_opacity = OPACITY
    """Opacity of the first Gaussians, where the user gives none."""

    leaves_room = False
    """Whether Gaussians that reach a viewpoint are shrunk (`clsplat.training.camera_room`), and those removed that
    lie before a plain background (`clsplat.dataset.outlines`) or, at the end, that no photo shows: all of them would
    be seen from new viewpoints only."""

    def __init__(self, config: TrainConfig, extent: float, n: int) -> None:
        self.statistics: dict[str, Any] = {}

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Follow the removal of some rows of the last edit; its statistics are on the host."""
        self.statistics = {name: array[kept] for name, array in self.statistics.items()}

    def on(self, device: "Device | None") -> "Strategy":
        """The strategy with its statistics on the device, or on the host for None."""

        def placed(name: str, array: Any) -> Any:
            if device is None:
                return download(array)
            return device.upload(name, array, array.dtype) if isinstance(array, np.ndarray) else array

        result = copy(self)
        result.statistics = {name: placed(name, array) for name, array in self.statistics.items()}
        return result

    def take(self, rows: Array) -> "Strategy":
        """A strategy that shares no statistics with this one and has copies of some rows, on the host."""
        result = copy(self)
        result.statistics = {name: array[rows] for name, array in self.statistics.items()}
        return result

    def restore(self, statistics: dict[str, Array]) -> None:
        """Continue with the statistics of a checkpoint.

        Raises
        ------
        ValueError
            If names, types or shapes are not those of this strategy's statistics.
        """
        found = {name: (array.dtype, array.shape) for name, array in statistics.items()}
        expected = {name: (array.dtype, array.shape) for name, array in self.statistics.items()}
        if found != expected:
            raise ValueError(f"statistics: expected {expected}, found {found}")
        self.statistics = statistics

    def watches(self, iteration: int) -> bool:
        """Whether `observe` is called in an iteration, counted from 1."""
        return False

    def observe(self, stages: Stages, extents: Any, v_means2d: Any, width: int, height: int) -> None:
        """Add one iteration to the statistics.

        Parameters
        ----------
        stages : Stages
            The functions of the stages, working where the arrays and the statistics are.
        extents, v_means2d : (N, 2)
            Extents of the splats, px, and the gradients with respect to their centres, per pixel.
        width, height : int
            Size of the image, px.
        """

    def penalties(self, n: int) -> tuple[float, float]:
        """Weights in the loss of the sum of all opacities and of the sum of all scales of n Gaussians."""
        return 0.0, 0.0

    def perturb(self, stages: Stages, gaussians: Gaussians, iteration: int, rate: float) -> None:
        """Change the Gaussians in place after the step of the optimiser.

        Parameters
        ----------
        stages : Stages
            As given to `observe`.
        gaussians : Gaussians
            Arrays where the stages work.
        iteration : int
            Number of the iteration, counted from 1.
        rate : float
            Learning rate of the means in this iteration, world units.
        """

    def due(self, iteration: int) -> bool:
        """Whether an edit is due after an iteration, counted from 1."""
        return False

    def edit(self, iteration: int, gaussians: Gaussians, cap: int, survey: Survey) -> Edit:
        """Make the edit that is due after an iteration.

        Parameters
        ----------
        iteration : int
            Number of the iteration, counted from 1.
        gaussians : Gaussians
            On the host, without spherical harmonics in a training; they stay as they are.
        cap : int
            Largest number of Gaussians after the edit: the user's limit or what fits the device. There may be more
            before it; then none are added.
        survey : callable
            Renders training photos and returns contributions to them.

        Returns
        -------
        Edit
            The statistics have its rows.
        """
        raise NotImplementedError
