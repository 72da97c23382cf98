"""Validation of a scene on blocks of pixels of some training photos."""

from dataclasses import replace
from math import log10

import numpy as np

from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.render import renderings
from clsplat.renderer import Renderer
from clsplat.scene import View

VALIDATING = 12
"""Training photos, evenly spaced by name, of which blocks validate. Every photo still trains in part, so that no
viewpoint is missing."""

FEWEST_VALIDATING = 2
"""Fewest photos with pixels that validate: the error of a mean cannot be estimated from one."""

BLOCKS = 8
"""Blocks along each edge of a photo that validates."""

EVERY_BLOCK = 4
"""Spacing of the blocks that validate along a row; they move by two blocks in the next row and by one in the next
photo."""

FEWEST_PHOTOS = 8
"""Fewest training photos with which the number of Gaussians is searched: fewer photos are all needed for training."""

PERFECT = 20 * log10(255)
"""Largest PSNR that counts, dB: that of an error of one level of 255. More Gaussians for smaller errors, which nobody
sees, would otherwise seem to pay."""


def split(views: list[View]) -> tuple[list[View], list[View]]:
    """Divide photos into parts that train and parts that validate, by their masks.

    Returns
    -------
    training : list of View
        All views; those that validate without their validation blocks.
    validation : list of View
        Views with their validation blocks alone; those without a pixel that counts are left out.
    """
    chosen = np.unique(np.linspace(0, len(views) - 1, min(VALIDATING, len(views))).round().astype(int))
    training, validation = list(views), []
    for k, i in enumerate(chosen):
        height, width = views[i].image.shape[:2]
        row, column = np.arange(height)[:, None] * BLOCKS // height, np.arange(width) * BLOCKS // width
        held = (column + 2 * row + k) % EVERY_BLOCK == 0
        counts = np.ones((height, width), bool) if views[i].mask is None else views[i].mask
        training[i] = replace(views[i], mask=counts & ~held)
        if (counts & held).any():
            validation.append(replace(views[i], mask=counts & held))
    return training, validation


def can_validate(views: list[View]) -> bool:
    """Whether there are enough photos to search the number of Gaussians."""
    return len(views) >= FEWEST_PHOTOS and len(split(views)[1]) >= FEWEST_VALIDATING


def validate(gaussians: Gaussians, views: list[View], renderer: Renderer, sh_degree: int) -> list[float]:
    """PSNR of each view, dB and up to `PERFECT`, of renders rounded to 8 bits."""
    cameras, degree = [view.camera for view in views], min(sh_degree, gaussians.sh_degree)
    pairs = zip(renderings(renderer, gaussians, cameras, degree), views, strict=True)
    return [min(PERFECT, psnr(to_uint8(rendering.rgb), view.image, view.mask)) for rendering, view in pairs]
