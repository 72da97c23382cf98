"""The sentences with which `clsplat train` ends: how well the scene holds in held-out photos, and what would help."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.bench.measures import training_psnr
from clsplat.dataset.brightness import evened
from clsplat.dataset.coverage import VIEWS_MIN, rare_pixels

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.render import Stored
    from clsplat.renderer import Renderer
    from clsplat.scene import Scene

RARE = 0.05
"""Fraction of a photo's pixels that few training photos must show to be named as the reason of its errors."""

EXPOSURE_GAIN = 1.0
"""Gain of PSNR, dB, by a fit of the held-out photos' colours from which their exposures are said to differ."""


def generalisation(
    gaussians: "Gaussians | Stored", scene: "Scene", report: dict[str, Any], renderer: "Renderer", exposure: bool
) -> str:
    """Say how well a scene holds in its held-out photos.

    Parameters
    ----------
    gaussians : Gaussians or Stored
    scene : Scene
        With training and held-out photos.
    report : dict
        The result of `clsplat.evaluate.evaluate` on the held-out photos.
    renderer : Renderer
    exposure : bool
        Whether training learned the exposures of its photos.

    Returns
    -------
    str
        One paragraph.
    """
    trained = training_psnr(gaussians, evened(scene).train, renderer)["train_psnr"]
    held, fitted = report["mean"]["psnr"], report["mean"]["psnr_fitted"]
    if held is None or trained is None:
        return f"{len(scene.test)} held-out photos, without errors in at least one"
    difference = round(trained - held, 1) or 0.0  # without the sign of minus zero
    text = (
        f"{len(scene.test)} held-out photos have {held:.1f} dB, training photos {trained:.1f} dB: the smaller "
        f"the difference of {difference:.1f} dB, the better the scene holds from new viewpoints. "
    )
    worst = min(report["views"], key=lambda view: np.inf if view["psnr"] is None else view["psnr"])
    text += f"The weakest is {worst['name']}, {worst['psnr']:.1f} dB: {_reason(scene, worst['name'])}"
    if fitted is not None and fitted - held > EXPOSURE_GAIN:
        advice = (
            "compare runs with --exposure by this figure" if exposure else "where exposures differ, try --exposure"
        )
        text += f". After a fit of colours it would be {fitted:.1f} dB: {advice}"
    return text


def _reason(scene: "Scene", name: str) -> str:
    """Likely reason for a photo's errors, and the remedy."""
    view = next(view for view in scene.test if view.name == name)
    masks = rare_pixels(replace(scene, test=[view]), scene.points) if len(scene.points) else None
    if masks is None:
        return "more photos from there would help most"
    share, side = float(masks[0].mean()), _side(masks[0])
    if share < RARE:
        return f"{VIEWS_MIN} or more training photos have each part of it in their frame; photos between would help"
    return (
        f"{share:.0%} of it, mostly {side}, is in the frame of fewer than {VIEWS_MIN} training photos; more photos "
        "of this part would help most"
    )


def _side(mask: NDArray[np.bool_]) -> str:
    """The half of a photo in which a mask is true most often."""
    height, width = mask.shape
    halves = {
        "on the left": mask[:, : width // 2],
        "on the right": mask[:, width // 2 :],
        "at the top": mask[: height // 2],
        "at the bottom": mask[height // 2 :],
    }
    return max(halves, key=lambda name: halves[name].mean())
