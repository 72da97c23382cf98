"""Frames of the viewer: one picture of the scene, drawn as the user chose."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.renderer import Renderer, download
from clsplat.scene import Color
from clsplat.surface import scene_depth

MODES = ("render", "depth", "normals", "alpha", "count")
"""Contents of a frame: colours, the expected depth, the normals of its surface, 1 - transmittance, or the number of
Gaussians drawn per pixel."""

SPLASH_EDGE = 1280
"""Longer edge of a frame with a sentence, px; the browser enlarges it."""

SPLASH_COLORS = (32, 32, 36), (190, 190, 196)
"""Background and text of such a frame, RGB."""

SOLID = 0.5
"""Opacity from which on a pixel has a depth: most of its light comes from the scene."""


class Look(NamedTuple):
    """Settings of a frame: one of `MODES`, the colour behind the scene, and the highest degree of the spherical
    harmonics. None takes the renderer's background and all degrees."""

    mode: str = MODES[0]
    background: Color | None = None
    sh_degree: int | None = None


def picture(
    renderer: Renderer, gaussians: Gaussians, camera: Camera, look: Look = Look()
) -> tuple[NDArray[np.uint8], str]:
    """Render one frame.

    Parameters
    ----------
    renderer : Renderer
    gaussians : Gaussians
        On the host or on the renderer's device.
    camera : Camera
    look : Look

    Returns
    -------
    frame : (H, W, 3) uint8
    legend : str
        Explanation of the frame's colours. Empty for the mode "render".
    """
    mode = look.mode
    degree = None if look.sh_degree is None else min(look.sh_degree, gaussians.sh_degree)
    run = renderer.forward(
        gaussians,
        camera,
        degree,
        background=look.background,
        depth=mode in ("depth", "normals"),
        gradients=False,
    )
    if mode == "count":
        count = download(renderer.stages.count_pairs(run.drawn, run.bins)[1])
        most = max(int(count.max()), 1)
        return _colored(count / most), f"dark 0, bright {most} Gaussians per pixel; mean {count.mean():.1f}"
    image, alpha = download(run.image.rgb), download(run.image.alpha)
    if mode == "alpha":
        return to_uint8(np.repeat(alpha[:, :, None], 3, axis=2)), "black transparent, white opaque"
    if mode in ("depth", "normals"):
        solid = alpha > SOLID
        if not solid.any():
            return np.zeros((*alpha.shape, 3), np.uint8), "nothing opaque in view"
        depth = image[:, :, 3] / np.where(solid, alpha, 1)
        if mode == "normals":
            frame = to_uint8(0.5 - 0.5 * normals(depth, camera) * [-1, 1, 1])
            return np.where(solid[:, :, None], frame, 0).astype(np.uint8), (
                "red to the right, green up, blue to the camera"
            )
        near, far = np.percentile(depth[solid & (depth <= scene_depth(depth[solid]))], [2, 98])
        frame = _colored(1 - (depth - near) / max(far - near, 1e-12))
        return np.where(solid[:, :, None], frame, 0).astype(np.uint8), f"bright {near:.3g}, dark {far:.3g} units away"
    return to_uint8(image), ""


def splash(text: str, width: int, height: int) -> NDArray[np.uint8]:
    """A dark frame (H, W, 3) uint8 with a sentence, for a page that has no scene yet."""
    from PIL import Image, ImageDraw, ImageFont

    scale = min(1.0, SPLASH_EDGE / max(width, height))
    size = max(1, round(scale * width)), max(1, round(scale * height))
    image = Image.new("RGB", size, SPLASH_COLORS[0])
    font = ImageFont.load_default(max(12, size[0] // 40))
    ImageDraw.Draw(image).text((size[0] / 2, size[1] / 2), text, SPLASH_COLORS[1], font, "mm")
    return np.asarray(image)


def normals(depth: NDArray[Any], camera: Camera) -> NDArray[np.float64]:
    """Normals of the surface that a depth map describes.

    Parameters
    ----------
    depth : (H, W)
        World units.
    camera : Camera
        A pinhole.

    Returns
    -------
    (H, W, 3) float64
        Unit vectors in camera coordinates, which point to the camera; zero where the image has less than 2 rows or
        columns.
    """
    height, width = depth.shape
    if min(height, width) < 2:
        return np.zeros((height, width, 3))
    x = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(height) + 0.5 - camera.cy) / camera.fy
    points = np.stack([depth * x, depth * y[:, None], depth], axis=2).astype(np.float64)
    result = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    return np.asarray(result / np.maximum(np.linalg.norm(result, axis=2, keepdims=True), 1e-300))


def scaled_depth(depth: NDArray[Any]) -> NDArray[np.uint16]:
    """Depths (H, W) as 16-bit levels of the largest one; 0 where they are negative."""
    return np.rint(np.clip(depth / max(float(depth.max()), 1e-12), 0, 1) * 65535).astype(np.uint16)


def colored_normals(normals: NDArray[Any], camera: Camera) -> NDArray[np.uint8]:
    """Normals (H, W, 3) in world coordinates as colours: red to the right, green up, blue to the camera.

    Black where there is none.
    """
    frame = to_uint8(0.5 + 0.5 * (normals @ camera.viewmat[:3, :3].T) * [1, -1, -1])
    return np.where(normals.any(axis=2, keepdims=True), frame, 0).astype(np.uint8)


def _colored(values: NDArray[Any]) -> NDArray[np.uint8]:
    from matplotlib import colormaps

    return np.asarray(colormaps["inferno"](np.clip(values, 0, 1), bytes=True)[:, :, :3])
