"""Check of a scene that has been trained: whether it shows anything of its photos."""

import numpy as np
from numpy.typing import NDArray

from clsplat.config import AdcConfig
from clsplat.gaussians import Gaussians
from clsplat.render import Stored, renderings
from clsplat.renderer import Renderer
from clsplat.scene import View, evenly_spaced, in_turn

FEWEST_GAUSSIANS = AdcConfig.min_gaussians
"""Number of Gaussians below which a training has failed: what pruning leaves at least."""

CHECKED = 8
"""Number of training photos, evenly spaced, that are compared with a constant colour."""

LEVEL = 1 / 255
"""Root mean square of a photo's differences from its mean colour up to which it shows nothing."""

NOTHING_SHOWN = (
    "each of its photos has a single colour, or no pixel that counts, and no scene follows from that; look at the "
    "photos and masks"
)
"""Reason of a failure where no photo shows anything."""


def failure(gaussians: Gaussians | Stored, views: list[View], renderer: Renderer) -> str | None:
    """Say why a scene is a failure, if it has almost no Gaussians, or a constant colour is closer to its photos.

    Parameters
    ----------
    gaussians : Gaussians or Stored
        The trained scene.
    views : list of View
        The training photos.
    renderer : Renderer

    Returns
    -------
    str or None
        A sentence with what to look at; None if the scene shows something of its photos.
    """
    advice = "look at the photos, their poses and masks, and train for more --iterations"
    if not any(map(_shows_something, in_turn(views))):
        return f"training failed: {NOTHING_SHOWN}"
    if len(gaussians) < FEWEST_GAUSSIANS:
        return f"training failed: only {len(gaussians)} Gaussians are left; {advice}"
    chosen = evenly_spaced(views, CHECKED)
    errors, variances = [], []
    pairs = zip(in_turn(chosen), renderings(renderer, gaussians, [v.camera for v in chosen]), strict=True)
    for view, rendering in pairs:
        counts = view.counts
        photo = view.image[counts] / 255
        if _varies(photo):
            errors.append(np.mean((np.clip(rendering.rgb[counts], 0, 1) - photo) ** 2))
            variances.append(photo.var(axis=0).mean())
    if not errors or np.mean(errors) < np.mean(variances):
        return None
    found, constant = (-10 * np.log10(np.mean(values)) for values in (errors, variances))
    return (
        f"training failed: its photos have {found:.1f} dB, where a constant colour for each has {constant:.1f} dB; "
        f"{advice}"
    )


def _varies(pixels: NDArray[np.float64]) -> bool:
    """Whether pixels (P, 3) in [0, 1] differ from one colour."""
    return len(pixels) > 0 and float(pixels.var(axis=0).mean()) > LEVEL**2


def _shows_something(view: View) -> bool:
    """Whether a photo has more than one colour, or a transparency with a shape."""
    counts = view.counts
    layers = [view.image] if view.clear is None else [view.image, view.clear[..., None]]
    return any(_varies(layer[counts] / 255) for layer in layers)
