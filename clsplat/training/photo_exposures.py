"""Per-photo exposure: a map between the scene's colours and those of each training photo.

Automatic cameras change exposure and white balance from photo to photo. Without a map, the Gaussians explain these
changes by view dependence and haze (Rematas et al. 2022, section 3.2). The maps are determined only up to a common
change of the scene's colours; their mean is kept at the identity, so that the scene has the mean colours of the
photos. The vignetting of a lens is common to all photos and all channels. With a falloff per channel, the tint of an
object that all photos show in their middle would become the lens's.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import OptimConfig
from clsplat.reference.exposure import squared_radius
from clsplat.training.photo_parameters import PerPhoto

Array = NDArray[Any]

IDENTITY = np.eye(3, 4)

RESPONSE = np.eye(3, 6)
"""The identity with the columns of the camera's response and of the vignetting."""

FALLOFF = 5
"""The column of the vignetting."""

GAIN_RATE = 10.0
"""Learning rate of the gains, the diagonal of a map, as a multiple of that of the other numbers. Most changes of a
camera are gains. Adam moves all numbers by about the same step: at one rate, it would mix channels and shift black
in place of most of a gain (docs/stages/exposure.md)."""


def start(names: list[str], response: bool = False) -> PerPhoto:
    """Identity maps, (V, 3, 4) for V photos; with `response` (V, 3, 6), with curves and vignetting."""
    identity = RESPONSE if response else IDENTITY
    return PerPhoto.start(names, identity, identity.shape)


def update(exposures: PerPhoto, name: str, v_affine: Array, progress: float, config: OptimConfig) -> None:
    """Take a step on a photo's map by its gradient, of the shape of the map; the rates fall with progress, 0 to 1,
    through the training."""
    rate = config.exposure_lr * (config.exposure_lr_final / config.exposure_lr) ** progress
    rates = np.where(np.eye(*v_affine.shape) == 1, GAIN_RATE * rate, rate)
    gradient = v_affine.copy()
    gradient[:, FALLOFF:] = v_affine[:, FALLOFF:].mean(axis=0)
    exposures.of(name)[:] += exposures.step(name, gradient, rates, config)
    values = exposures.values
    values[:, :, :FALLOFF] += RESPONSE[:, : min(FALLOFF, values.shape[2])] - values[:, :, :FALLOFF].mean(axis=0)
    values[:, :, FALLOFF:] = np.minimum(exposures.of(name)[:, FALLOFF:], 0)  # a lens darkens the corners


def neutral(photo: NDArray[np.uint8], affine: Array) -> NDArray[np.uint8]:
    """Undo a photo's map; the result (H, W, 3) is rounded and clamped to 8 bits."""
    y = photo / 255 - affine[:, 3]
    inverse = np.linalg.inv(affine[:, :3]).T
    colours = y @ inverse
    if affine.shape[1] == 6:
        r2 = squared_radius(*photo.shape[:2])
        # The bent terms are small, and each round reduces the error by their slope: to a hundredth of a level.
        for _ in range(8):
            colours = (y - affine[:, 4] * colours * (1 - colours) - affine[:, 5] * r2 * colours) @ inverse
    return np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)
