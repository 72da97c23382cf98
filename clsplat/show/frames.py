"""Frames of the viewer: one picture of the scene in the mode that the user chose."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.renderer import Renderer, download

MODES = ("render", "depth", "alpha", "count")
"""Contents of a frame: colours, the expected depth, 1 - transmittance, or the number of Gaussians drawn per pixel."""


def picture(renderer: Renderer, gaussians: Gaussians, camera: Camera, mode: str) -> tuple[NDArray[np.uint8], str]:
    """Render one frame.

    Parameters
    ----------
    renderer : Renderer
    gaussians : Gaussians
        On the host or on the renderer's device.
    camera : Camera
    mode : str
        One of `MODES`.

    Returns
    -------
    frame : (H, W, 3) uint8
    legend : str
        Explanation of the frame's colours. Empty for the mode "render".
    """
    run = renderer.forward(gaussians, camera, depth=mode == "depth", gradients=False)
    if mode == "count":
        count = download(renderer.stages.count_pairs(run.splats, run.bins)[1])
        most = max(int(count.max()), 1)
        return _colored(count / most), f"dark 0, bright {most} Gaussians per pixel; mean {count.mean():.1f}"
    image, alpha = download(run.image.rgb), download(run.image.alpha)
    if mode == "alpha":
        return to_uint8(np.repeat(alpha[:, :, None], 3, axis=2)), "black transparent, white opaque"
    if mode == "depth":
        solid = alpha > 0.5
        if not solid.any():
            return np.zeros((*alpha.shape, 3), np.uint8), "nothing opaque in view"
        depth = image[:, :, 3] / np.where(solid, alpha, 1)
        near, far = np.percentile(depth[solid], [2, 98])
        frame = _colored(1 - (depth - near) / max(far - near, 1e-12))
        return np.where(solid[:, :, None], frame, 0).astype(np.uint8), f"bright {near:.3g}, dark {far:.3g} units away"
    return to_uint8(image), ""


def _colored(values: NDArray[Any]) -> NDArray[np.uint8]:
    from matplotlib import colormaps

    return np.asarray(colormaps["inferno"](np.clip(values, 0, 1), bytes=True)[:, :, :3])
