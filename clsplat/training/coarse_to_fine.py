"""Coarse to fine: training starts with smaller photos, whose steps cost less."""

from dataclasses import replace

import numpy as np
from PIL import Image

from clsplat.config import TrainConfig
from clsplat.dataset.decoding import nearest
from clsplat.scene import View


def factor_at(iteration: int, config: TrainConfig) -> int:
    """Divisor of the photos' edges in an iteration, counted from 1. It is halved at equal intervals down to 1.

    It is 1 where the configuration leaves the first one open (`clsplat.training.run_length.with_length` chooses it).
    Chen et al. 2025, "DashGaussian", derive the schedule of the resolution from the photos' spectra instead.
    """
    span = config.coarse.until * config.iterations
    if iteration > span or not config.coarse.factor:
        return 1
    halvings = config.coarse.factor.bit_length() - 1
    return config.coarse.factor >> int((iteration - 1) / span * halvings)


def shrunk(view: View, factor: float) -> View:
    """Reduce a view: divide its edges by `factor` (rounded), average boxes of pixels, and adapt the camera.

    A pixel counts if all the pixels that it averages count.
    """
    if factor == 1:
        return view
    width, height = max(1, round(view.camera.width / factor)), max(1, round(view.camera.height / factor))

    def boxes(array: np.ndarray) -> np.ndarray:
        return np.asarray(Image.fromarray(array).resize((width, height), Image.Resampling.BOX))

    def reduced(full: View) -> View:
        mask = None if full.mask is None else boxes(np.where(full.mask, 255, 0).astype(np.uint8)) == 255
        clear = None if full.clear is None else boxes(full.clear)
        # Means of depths on both sides of an edge would be depths of neither.
        depth = full.depth and replace(full.depth, values=nearest(full.depth.values, height, width))
        return replace(full, camera=camera, image=boxes(full.image), mask=mask, clear=clear, depth=depth)

    camera = view.camera.resized(width, height)
    return view.changed(reduced, camera)
