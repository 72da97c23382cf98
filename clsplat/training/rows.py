"""Rows: what training keeps for each Gaussian."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians
from clsplat.pruning.prices import with_degree
from clsplat.renderer import fetch
from clsplat.stages import Stages
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
        return Rows(self.gaussians.take(rows), self.moments.take(rows), self.strategy.take(rows))

    def to_edit(self) -> "Rows":
        """The same rows as strategies edit them: on the host, but for the moments, which stay where they are."""
        return Rows(fetch(self.gaussians), self.moments, self.strategy.on(None))

    def after(self, edit: Edit, stages: Stages) -> "Rows":
        """The rows after an edit of `to_edit`. The moments are where they were, which is where `stages` run."""
        moments = self.moments.take(np.where(edit.fresh, -1, edit.rows), stages)
        if edit.reset_opacities:
            for each in (moments.first, moments.second):
                each.logit_opacities = stages.take_rows(each.logit_opacities, np.full(len(edit.rows), -1))
        return Rows(edit.gaussians, moments, self.strategy)

    def with_degree(self, degree: int) -> "Rows":
        """The rows without the bands of the spherical harmonics above a degree, on the host."""
        moments = Moments(with_degree(self.moments.first, degree), with_degree(self.moments.second, degree))
        return Rows(with_degree(self.gaussians, degree), moments, self.strategy)
