"""Rows: what training keeps for each Gaussian."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians
from clsplat.pruning.prices import with_degree
from clsplat.renderer import fetch
from clsplat.training.densify import Edit, Strategy
from clsplat.training.optimizer import Moments

if TYPE_CHECKING:
    from clsplat.device import Device


class Rows(NamedTuple):
    """Parameters, Adam's moments, and the strategy with its statistics: one row per Gaussian, all in one place."""

    gaussians: Gaussians
    moments: Moments
    strategy: Strategy

    def on(self, device: "Device | None") -> "Rows":
        """The same rows on the device, or on the host for None."""

        def place(gaussians: Gaussians) -> Gaussians:
            if device is None:
                return fetch(gaussians)
            if not isinstance(gaussians.means, np.ndarray):
                return gaussians
            arrays: dict[str, Any] = {n: device.upload(n, array) for n, array in gaussians.arrays().items()}
            return Gaussians(**arrays)

        moments = Moments(place(self.moments.first), place(self.moments.second))
        return Rows(place(self.gaussians), moments, self.strategy.on(device))

    def take(self, rows: NDArray[Any]) -> "Rows":
        """Copies of some rows, on the host."""
        moments = self.moments.take(rows, np.zeros(len(rows), bool))
        return Rows(self.gaussians.take(rows), moments, self.strategy.take(rows))

    def after(self, edit: Edit) -> "Rows":
        """The rows after an edit of the strategy, on the host."""
        moments = self.moments.take(edit.rows, edit.fresh)
        if edit.reset_opacities:
            moments.first.logit_opacities[:] = 0
            moments.second.logit_opacities[:] = 0
        return Rows(edit.gaussians, moments, self.strategy)

    def with_degree(self, degree: int) -> "Rows":
        """The rows without the bands of the spherical harmonics above a degree, on the host."""
        moments = Moments(with_degree(self.moments.first, degree), with_degree(self.moments.second, degree))
        return Rows(with_degree(self.gaussians, degree), moments, self.strategy)
