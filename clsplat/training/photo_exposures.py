"""Per-photo exposure: an affine map between the scene's colours and those of each training photo.

Automatic cameras change exposure and white balance from photo to photo. Without a map, the Gaussians explain these
changes by view dependence and haze (Rematas et al. 2022, section 3.2). The maps are determined only up to a common
factor; their mean is kept at the identity, so that the scene has the mean colours of the photos.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import OptimConfig
from clsplat.training.photo_parameters import PerPhoto

Array = NDArray[Any]

IDENTITY = np.eye(3, 4)


def start(names: list[str]) -> PerPhoto:
    """Identity maps, (V, 3, 4) for V photos."""
    return PerPhoto.start(names, IDENTITY, IDENTITY.shape)


def update(exposures: PerPhoto, name: str, v_affine: Array, progress: float, config: OptimConfig) -> None:
    """Take a step on a photo's map by its gradient (3, 4); the rate falls with progress, 0 to 1, through the
    training."""
    rate = config.exposure_lr * (config.exposure_lr_final / config.exposure_lr) ** progress
    exposures.of(name)[:] += exposures.step(name, v_affine, rate, config)
    exposures.values += IDENTITY - exposures.values.mean(axis=0)


def neutral(photo: NDArray[np.uint8], affine: Array) -> NDArray[np.uint8]:
    """Undo a photo's map; the result (H, W, 3) is rounded and clamped to 8 bits."""
    colours = np.linalg.solve(affine[:, :3], (photo.reshape(-1, 3) / 255 - affine[:, 3]).T).T
    return np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8).reshape(photo.shape)
