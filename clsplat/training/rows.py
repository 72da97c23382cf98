"""Rows: what training keeps for each Gaussian."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import SHAPES, Gaussians
from clsplat.pruning.prices import with_degree
from clsplat.renderer import fetch
from clsplat.training.densify import Edit, Strategy
from clsplat.training.optimizer import Moments, Optimizer

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
            uploaded: dict[str, Any] = {
                name: device.upload(name, array)
                for name, array in gaussians.arrays().items()
                if isinstance(array, np.ndarray)
            }
            return replace(gaussians, **uploaded)

        moments = Moments(place(self.moments.first), place(self.moments.second))
        return Rows(place(self.gaussians), moments, self.strategy.on(device))

    def take(self, rows: NDArray[Any]) -> "Rows":
        """Copies of some rows, on the host."""
        return Rows(self.gaussians.take(rows), self.moments.take(rows), self.strategy.take(rows))

    def after(self, edit: Edit, optimizer: Optimizer) -> "Rows":
        """The rows after an edit: its Gaussians are on the host, all else is where the optimiser works.

        The arrays of this object are replaced one by one, because old and new ones together may exceed the memory.
        """
        take, unlike = optimizer.stages.take_rows, {}
        self.gaussians.sh = take(self.gaussians.sh, optimizer.place_rows(edit.rows))
        if edit.reset_opacities:
            unlike["logit_opacities"] = optimizer.place_rows(np.full(len(edit.rows), -1))
        continued = optimizer.place_rows(np.where(edit.fresh, -1, edit.rows))
        for moments in (self.moments.first, self.moments.second):
            for name in SHAPES:
                setattr(moments, name, take(getattr(moments, name), unlike.get(name, continued)))
        return Rows(replace(edit.gaussians, sh=self.gaussians.sh), self.moments, self.strategy)

    def with_degree(self, degree: int) -> "Rows":
        """The rows without the bands of the spherical harmonics above a degree, on the host."""
        moments = Moments(with_degree(self.moments.first, degree), with_degree(self.moments.second, degree))
        return Rows(with_degree(self.gaussians, degree), moments, self.strategy)


def without_harmonics(gaussians: Gaussians) -> Gaussians:
    """Gaussians on the host without spherical harmonics, most of their numbers, which no edit changes."""
    return fetch(replace(gaussians, sh=np.empty((len(gaussians), 0, 3), np.float32)))
