"""Validation of a scene on photos that are held back from training."""

from math import log10
from typing import Any

import numpy as np

from clsplat.gaussians import Gaussians
from clsplat.metrics import colors_fitted
from clsplat.render import images
from clsplat.renderer import Renderer, download
from clsplat.scene import View, in_turn

HELD_SHARE = 1 / 6
"""Fraction of the training photos that is held back. With a smaller fraction decisions are less certain, with a
larger one the others show less of the scene."""

MOST_HELD = 16
"""Most photos that are held back. More make a decision little more certain, and each validation longer."""

FEWEST_HELD = 2
"""Fewest photos that validate: the error of a mean cannot be estimated from one."""

FEWEST_PHOTOS = 8
"""Fewest training photos with which the number of Gaussians can be searched, with two that are held back. From which
number on it is searched by default is decided by `clsplat.training.few_views`."""

PERFECT = 20 * log10(255)
"""Largest PSNR that counts, dB: that of an error of one level of 255. More Gaussians for smaller errors, which nobody
sees, would otherwise seem to pay."""


def split(views: list[View]) -> tuple[list[View], list[View]]:
    """Divide photos into those that train and those that are held back to validate.

    The photos that are held back are evenly spaced by name. They begin with the first one, which is often at an end
    of the camera's path: a scene must also hold where few other photos look.

    Returns
    -------
    training, held : list of View
        Photos without a pixel that counts are not held back.
    """
    shown = [i for i, view in enumerate(views) if view.is_used]
    count = min(MOST_HELD, max(FEWEST_HELD, int(HELD_SHARE * len(views))), len(shown))
    held = {shown[k * len(shown) // count] for k in range(count)}
    return [view for i, view in enumerate(views) if i not in held], [views[i] for i in sorted(held)]


def can_validate(views: list[View]) -> bool:
    """Whether there are enough photos to search the number of Gaussians."""
    return len(views) >= FEWEST_PHOTOS and len(split(views)[1]) >= FEWEST_HELD


def validate(
    gaussians: Gaussians, views: list[View], renderer: Renderer, sh_degree: int, *, fitted: bool = False
) -> list[float]:
    """Quality of each view, dB: the mean of its PSNR and of its SSIM in decibels.

    PSNR alone values a blurred surface as much as a sharp one that is slightly off. SSIM in decibels is
    -10 log10(1 - SSIM), so that both grow by the same amount when their errors are halved.

    Parameters
    ----------
    gaussians : Gaussians
    views : list of View
    renderer : Renderer
    sh_degree : int
        Highest degree of the spherical harmonics evaluated.
    fitted : bool
        Compare after the affine map of the render's colours that fits the photo best. Where exposures are learned,
        that of a photo which does not train is unknown.

    Returns
    -------
    list of float
        Both parts are at most `PERFECT`.
    """
    cameras, degree = [view.camera for view in views], min(sh_degree, gaussians.sh_degree)
    pairs = zip(images(renderer, gaussians, cameras, degree), in_turn(views), strict=True)
    return [_quality(image, view, renderer, fitted) for image, view in pairs]


def _quality(image: Any, view: View, renderer: Renderer, fitted: bool) -> float:
    """Quality of an image that lies where the stages run."""
    counts = view.counts
    if fitted:
        shown = np.clip(download(image), 0, 1)
        image = renderer.upload("image", np.clip(colors_fitted(shown, view.image / 255, counts), 0, 1))
    photo = renderer.upload("photo", view.image, np.uint8)
    residuals = download(renderer.stages.removal_residuals(image, photo, clamped=True))
    square = np.square(residuals if view.mask is None else residuals[counts]).mean(dtype=np.float64)
    unlike, _ = renderer.stages.l1_ssim(image, photo, 1.0, renderer.upload("mask", counts, np.uint8))
    return (decibels(float(square)) + decibels(float(unlike) / counts.mean())) / 2


def decibels(error: float) -> float:
    """An error in decibels, at most `PERFECT`; NaN if it is not a number."""
    return -10 * log10(max(error, 10 ** (-PERFECT / 10)))
