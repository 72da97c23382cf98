"""Contributions of Gaussians to photos and to the errors in them."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians
from clsplat.pruning.prices import measure_removals
from clsplat.renderer import Pass, Renderer, download
from clsplat.scene import View
from clsplat.stages import Image, Removal
from clsplat.training.densify import Contributions

FIELDS = {
    "weights": "weights",
    "errors": "shares",
    "prices": "errors",
    "differences": "differences",
    "pairs": "pairs",
}
"""Fields of `clsplat.stages.Removal` by those of `Contributions` that are their sums over photos."""


def contributions(
    renderer: Renderer, gaussians: Gaussians, views: Iterable[View], sh_degree: int | None = None
) -> Contributions:
    """Add up over photos each Gaussian's part in their squared errors.

    Parameters
    ----------
    renderer : Renderer
    gaussians : Gaussians of N >= 1 rows
        On the host or on the renderer's device.
    views : iterable of View
        Pixels that their masks leave out do not count.
    sh_degree : int, optional
        Highest degree of the spherical harmonics evaluated; default: all that are stored.

    Returns
    -------
    Contributions
    """
    sums = {name: renderer.zeros(f"sums of {name}", (len(gaussians), 2)) for name in FIELDS}
    for measured in measure_removals(renderer, gaussians, views, sh_degree):
        for name, field in FIELDS.items():
            renderer.stages.add_column(measured.sums, Removal._fields.index(field), sums[name])
        del measured
    return Contributions(**{name: download(parts).astype(np.float64).sum(axis=1) for name, parts in sums.items()})


def weighted_sums(renderer: Renderer, run: Pass, values: NDArray[Any]) -> NDArray[np.float64]:
    """Sum values over the pixels of an image, weighted by each Gaussian's compositing weight alpha T.

    The image is linear in a splat's colour, and the derivative of a pixel by it is the splat's weight: the backward
    pass of these values gives the sums.

    Parameters
    ----------
    renderer : Renderer
    run : Pass
        Of N Gaussians.
    values : (H, W, C)
        Of 1 to 3 channels, on the host.

    Returns
    -------
    (N, C) float64
    """
    channels = values.shape[2]
    rgb = np.zeros((*values.shape[:2], 3))
    rgb[:, :, :channels] = values
    v_image = Image(renderer.upload("v_image", rgb), renderer.no_alpha_gradient(run.camera))
    return np.asarray(download(renderer.backward_to_splats(run, v_image).colors)[:, :channels], np.float64)
