"""Mip-Splatting's 3D smoothing filter in training (Yu et al. 2024, section 5.1; stage filter)."""

from typing import Any

from clsplat.gaussians import Gaussians
from clsplat.scene import View
from clsplat.stages import Stages

MEASURE_EVERY = 100
"""Iterations between two measurements of the pixel sizes (Mip-Splatting's code); every edit needs another as well."""


class SmoothingFilter:
    """The filter and the pixel sizes that it depends on.

    Attributes
    ----------
    pixels : (N,) array or None
        Smallest size of a pixel at each Gaussian, world units; None while they are to be measured: before the first
        iteration, and after the rows have changed.
    """

    def __init__(self, pixels: Any = None):
        self.pixels = pixels

    def due(self, iteration: int) -> bool:
        """Whether the pixel sizes are to be measured after an iteration, counted from 1."""
        return self.pixels is None or iteration % MEASURE_EVERY == 0

    def measure(self, stages: Stages, gaussians: Gaussians, views: list[View]) -> None:
        """Measure the pixel sizes of the views' cameras at each Gaussian."""
        self.pixels = stages.pixel_sizes(gaussians, [view.camera for view in views])

    def forget(self) -> None:
        """Discard the pixel sizes: they belong to other rows."""
        self.pixels = None

    def apply(self, stages: Stages, gaussians: Gaussians) -> Gaussians:
        """The Gaussians as they are rendered and saved."""
        return stages.filter_fwd(gaussians, self.pixels)

    def backward(self, stages: Stages, gaussians: Gaussians, v: Gaussians) -> Gaussians:
        """Gradients with respect to the Gaussians, from those with respect to the result of `apply`."""
        return stages.filter_bwd(gaussians, self.pixels, v)
