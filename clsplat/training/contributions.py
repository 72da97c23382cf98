"""Contributions of Gaussians to photos and to the errors in them."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from clsplat.gaussians import Gaussians
from clsplat.pruning.prices import Measured, measure_removals
from clsplat.renderer import Renderer, download
from clsplat.scene import View
from clsplat.stages import Image, Removal
from clsplat.training.densify import Contributions


def contributions(
    renderer: Renderer, gaussians: Gaussians, views: Iterable[View], sh_degree: int | None = None
) -> Contributions:
    """Add up over photos each Gaussian's part in their squared errors.

    The image is linear in a splat's colour, and its derivative by the colour is the splat's weight. The gradient of
    compositing with respect to the colours, for an image of gradients that are squared errors, therefore divides the
    errors among the splats by weight. The change of the error when a splat is removed comes from the stage removal.

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
    names = "weights", "errors", "prices", "differences", "pairs"
    sums = {name: renderer.zeros(f"sums of {name}", (len(gaussians), 2)) for name in names}
    for measured in measure_removals(renderer, gaussians, views, sh_degree):
        _add(renderer, measured, sums)
        del measured
    return Contributions(**{name: download(parts).astype(np.float64).sum(axis=1) for name, parts in sums.items()})


def _add(renderer: Renderer, measured: Measured, sums: dict[str, Any]) -> None:
    v = Image(measured.errors, renderer.no_alpha_gradient(measured.view.camera))
    renderer.stages.add_column(renderer.backward_to_splats(measured.run, v).colors, 0, sums["errors"])
    fields = {"weights": "weights", "prices": "errors", "differences": "differences", "pairs": "pairs"}
    for name, field in fields.items():
        renderer.stages.add_column(measured.sums, Removal._fields.index(field), sums[name])
