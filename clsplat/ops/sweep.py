"""Launches of the stage sweep (cl/sweep.cl)."""

from typing import Any

import numpy as np
from pyopencl.array import Array

from clsplat.constants import SWEEP_PLANES, SWEEP_RADIUS, SWEEP_VARIANCE_MIN
from clsplat.device import Device

# Zeros before and after each row (cl/sweep.cl), so that windows of vectors may begin outside the photo.
PAD = 8

# Rows of a work-item of sweep_scores: windows share the sums of rows, so that more rows save additions. On a GPU, the
# sums of more rows than these would be in private memory.
CPU_ROWS = 16
GPU_ROWS = 2 * SWEEP_RADIUS + 1


def _defines(device: Device) -> dict[str, Any]:
    lanes, rows = (8, CPU_ROWS) if device.is_cpu else (1, GPU_ROWS)
    return {"RADIUS": SWEEP_RADIUS, "VARIANCE_MIN": SWEEP_VARIANCE_MIN, "LANES": lanes, "ROWS": rows}


def sweep_scores(device: Device, photo: Array, sources: list[Array], maps: Array, planes: Array) -> Array:
    """Compare a photo with others that are seen through planes of constant depth.

    Parameters
    ----------
    photo : (H, W) real
        Grey values in [0, 1].
    sources : list of S >= 2 arrays (rows, columns) real
        Grey values of the other photos, of at least 2 x 2 pixels.
    maps : (S, 12) real
        A (3 x 3, row-major) and b of each source: a pixel at (x, y) on the plane of inverse depth q is at
        A (x, y, 1) + q b in the source, homogeneous, px.
    planes : (D,) real
        Inverse depths, 1/world units.

    Returns
    -------
    (D, H, W) real
        Mean of the two largest of the sources' normalised cross-correlations of windows, -1 to 1. A source that does
        not show the window counts as -1, and so do all of them where the photo is flat.
    """
    (height, width), count, defines = photo.shape, len(planes), _defines(device)
    lanes, stride = defines["LANES"], -(-width // 8) * 8 + 2 * PAD
    padded = device.empty("photo with margins", (height, stride))
    windows = device.empty("windows of the photo", (2, height, stride))
    textured = device.empty("textured pixels", (height, stride // lanes), np.uint8)
    warped = device.empty("photos on planes", (len(sources), SWEEP_PLANES, height, stride))
    scores = device.empty("scores", (count, height, width))

    def launch(kernel: str, size: tuple[int, ...], *arguments: Any) -> None:
        device.launch("sweep", kernel, size, list(arguments), defines=defines)

    launch("sweep_pad", (stride, height), width, stride, photo, padded)
    launch("sweep_windows", (stride, height), width, height, stride, padded, windows)
    launch("sweep_textured", (stride // lanes, height), height, stride, windows, textured)
    chunks = -(-width // lanes), -(-height // defines["ROWS"])
    for first in range(0, count, SWEEP_PLANES):
        some = min(SWEEP_PLANES, count - first)
        for s, source in enumerate(sources):
            seen = *source.shape[::-1], source, s, maps, planes, first, some
            launch("sweep_warp", (stride // lanes, height), width, height, stride, *seen, textured, warped)
        compared = len(sources), first, some, padded, windows, textured, warped
        launch("sweep_scores", (*chunks, some), width, height, stride, *compared, scores)
    return scores


def sweep_best(device: Device, scores: Array, planes: Array) -> tuple[Array, Array]:
    """Choose the depth of each pixel.

    Parameters
    ----------
    scores : (D, H, W) real
        Of `sweep_scores`.
    planes : (D,) real
        Inverse depths, 1/world units, ascending.

    Returns
    -------
    inverse : (H, W) real
        Inverse depth with the largest score, refined between the planes, 1/world units.
    largest : (H, W) real
        The score there; -1 where the best plane is the first or the last one.
    """
    count, height, width = scores.shape
    inverse, largest = (device.empty(name, (height, width)) for name in ("inverse depths", "largest scores"))
    arguments: list[Any] = [height * width, count, scores, planes, inverse, largest]
    device.launch("sweep", "sweep_best", (height * width,), arguments, defines=_defines(device))
    return inverse, largest
