"""What each Gaussian contributes to photos, and to the errors in them."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.config import RenderConfig
from clsplat.gaussians import Gaussians
from clsplat.render import backward_to_splats, download, forward, stage_functions, upload
from clsplat.scene import View
from clsplat.stages import Image
from clsplat.training.densify import Contributions

if TYPE_CHECKING:
    from clsplat.device import Device


def contributions(
    device: "Device",
    gaussians: Gaussians,
    views: Iterable[View],
    config: RenderConfig,
    background: Any,
    sh_degree: int,
) -> Contributions:
    """Add up over photos what each Gaussian has to do with their squared errors.

    The image is linear in a splat's colour, and its derivative is the splat's weight: the gradient of compositing
    with respect to the colours, for an image of gradients that are squared errors, shares these out by weight. What
    the removal of a splat does is the stage removal's to say.

    Parameters
    ----------
    gaussians : Gaussians of N >= 1 rows
        On the host or on the device.
    views : iterable of View
        Where they have a mask, pixels that do not train do not count.
    background : (3,) array on the host

    Returns
    -------
    Contributions
    """
    stage, n = stage_functions(device), len(gaussians)
    result = Contributions(np.zeros(n), np.zeros(n), np.zeros(n))
    if isinstance(gaussians.means, np.ndarray):
        gaussians = upload(device, gaussians)
    for view in views:
        run = forward(device, gaussians, view.camera, config, background, sh_degree)
        residuals = download(run.image.image) - view.image / 255
        squares = (residuals**2).sum(axis=2) * (1 if view.mask is None else view.mask)
        v_image = np.stack([squares, np.zeros_like(squares), np.zeros_like(squares)], axis=2)
        v = Image(device.upload("v_image", v_image), device.upload("v_alpha", np.zeros_like(squares)))
        result.errors[:] += download(backward_to_splats(device, run, v).colors)[:, 0]
        removal = stage.removal(run.splats, run.bins, background, residuals, view.mask)
        result.weights[:] += removal.weights
        result.prices[:] += removal.errors
    return result
