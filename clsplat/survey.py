"""What each Gaussian contributes to photos, and to the errors in them."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import RenderConfig
from clsplat.gaussians import Gaussians
from clsplat.render import backward_to_splats, download, forward, upload
from clsplat.scene import View
from clsplat.stages import Image

if TYPE_CHECKING:
    from clsplat.device import Device


def contributions(
    device: "Device",
    gaussians: Gaussians,
    views: Iterable[View],
    config: RenderConfig,
    background: Any,
    sh_degree: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums over views and pixels of the weights with which Gaussians are composited, alone and times the error.

    The image is linear in a splat's colour, and its derivative is the splat's weight: the gradient of compositing
    with respect to the colours, for an image of gradients of ones and of errors, is both sums.

    Parameters
    ----------
    gaussians : Gaussians of N >= 1 rows
        On the host or on the device.
    views : iterable of View
        Where they have a mask, pixels that do not train do not count.
    background : (3,) array on the host

    Returns
    -------
    weights, errors : (N,)
        The error of a pixel is the mean over RGB of its absolute difference from the photo.
    """
    total = np.zeros((len(gaussians), 3))
    if isinstance(gaussians.means, np.ndarray):
        gaussians = upload(device, gaussians)
    for view in views:
        run = forward(device, gaussians, view.camera, config, background, sh_degree)
        counted = np.ones(view.image.shape[:2]) if view.mask is None else view.mask.astype(float)
        error = np.abs(download(run.image.image) - view.image / 255).mean(axis=2)
        v_image = np.stack([counted, counted * error, np.zeros_like(error)], axis=2)
        v = Image(device.upload("v_image", v_image), device.upload("v_alpha", np.zeros_like(error)))
        total += download(backward_to_splats(device, run, v).colors)
    return total[:, 0], total[:, 1]
