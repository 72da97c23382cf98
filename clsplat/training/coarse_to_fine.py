"""Coarse to fine: training begins on smaller photos, whose steps cost in proportion to their pixels."""

from dataclasses import replace

import numpy as np
from PIL import Image

from clsplat.config import TrainConfig
from clsplat.scene import View


def factor_at(iteration: int, config: TrainConfig) -> int:
    """By which the photos' edges are divided in an iteration, counted from 1: halved at equal intervals down to 1.

    Chen et al. 2025, "DashGaussian", schedule the resolution as well; they find its steps in the photos' spectra.
    """
    span = config.coarse.until * config.iterations
    if iteration > span:
        return 1
    halvings = config.coarse.factor.bit_length() - 1
    return config.coarse.factor >> int((iteration - 1) / span * halvings)


def shrunk(view: View, factor: int) -> View:
    """The same view with edges divided by `factor`, rounded: means over boxes of pixels, and the camera to them.

    A pixel counts where all that it is the mean of counts.
    """
    if factor == 1:
        return view
    width, height = max(1, round(view.camera.width / factor)), max(1, round(view.camera.height / factor))

    def boxes(array: np.ndarray) -> np.ndarray:
        return np.asarray(Image.fromarray(array).resize((width, height), Image.Resampling.BOX))

    mask = None if view.mask is None else boxes(np.where(view.mask, 255, 0).astype(np.uint8)) == 255
    clear = None if view.clear is None else boxes(view.clear)
    camera = view.camera.resized(width, height)
    return replace(view, camera=camera, image=boxes(view.image), mask=mask, clear=clear)
