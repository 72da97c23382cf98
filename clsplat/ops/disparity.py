"""Launch of the stage disparity (cl/disparity.cl)."""

import numpy as np
from pyopencl.array import Array

from clsplat.device import Device
from clsplat.stages import AnyGrads, AnySplats

# Number of pixels per work-item on a CPU, and number of work-items on a GPU, where the host adds up their sums.
CPU_PIXELS = 4096
GPU_ITEMS = 2048


def pixel_shares(device: Device, pixels: int) -> tuple[int, int, int, int]:
    """Arguments of kernels that sum over pixels: items, first, step and count (cl/disparity.cl)."""
    if device.is_cpu:
        return -(-pixels // CPU_PIXELS), CPU_PIXELS, 1, CPU_PIXELS
    return GPU_ITEMS, 1, GPU_ITEMS, -(-pixels // GPU_ITEMS)


def disparity_fwd(device: Device, splats: AnySplats) -> None:
    """Replace the fourth channel of the splats' colours, their depth, by the inverse depth, in place.

    Parameters
    ----------
    splats : Splats or RaySplats of N >= 1 rows and 4 channels
        Not yet composited. The inverse depth of an invisible splat is 0.
    """
    n = len(splats.depths)
    device.launch("disparity", "disparity_fwd", (n,), [n, splats.depths, splats.colors])


def disparity_bwd(device: Device, splats: AnySplats, v_splats: AnyGrads) -> None:
    """Turn gradients by inverse depths into gradients by depths, in place.

    Parameters
    ----------
    splats : Splats or RaySplats
        As `disparity_fwd` changed them.
    v_splats : SplatGrads or RayGrads
        Gradients with respect to them; the fourth channel of their colours changes.
    """
    n = len(splats.depths)
    device.launch("disparity", "disparity_bwd", (n,), [n, splats.depths, v_splats.colors])


def disparity_loss(device: Device, image: Array, target: Array, weight: float) -> tuple[float, Array]:
    """Compare composited inverse depths with those of a depth map.

    Parameters
    ----------
    image : (H, W, 4) real
        RGB, then the composited inverse depth, 1/world units.
    target : (H, W) real
        Inverse depths of the map, 1/world units; 0 where it has none.
    weight : float
        Factor on the sum over the pixels, world units.

    Returns
    -------
    loss : float
        `weight` times the sum of the absolute differences where the map has a depth.
    rgb : (H, W, 3) real
        The first three channels, for losses of colours.
    """
    pixels = target.size
    items, *shares = pixel_shares(device, pixels)
    rgb, parts = device.empty("image without depth", (*target.shape, 3)), device.empty("parts of the depths", items)
    arguments = [pixels, items, *shares, image, target, rgb, parts]
    device.launch("disparity", "disparity_loss", (items,), arguments)
    return weight * float(parts.get().sum(dtype=np.float64)), rgb


def disparity_grad(device: Device, image: Array, target: Array, weight: float, v_rgb: Array) -> Array:
    """Gradients of `disparity_loss`, joined with those of a loss of colours.

    Parameters
    ----------
    image, target, weight
        As given to `disparity_loss`.
    v_rgb : (H, W, 3) real
        Gradient with respect to its `rgb`.

    Returns
    -------
    (H, W, 4) real
        Gradient of the sum of both losses with respect to `image`.
    """
    v_image = device.empty("v_image with depth", image.shape)
    arguments = [target.size, float(weight), image, target, v_rgb, v_image]
    device.launch("disparity", "disparity_grad", (target.size,), arguments)
    return v_image
