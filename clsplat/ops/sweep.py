"""Launches of the stage sweep (cl/sweep.cl)."""

from typing import Any

from pyopencl.array import Array

from clsplat.constants import SWEEP_RADIUS, SWEEP_VARIANCE_MIN
from clsplat.device import Device

# Zeros before and after each row (cl/sweep.cl), so that windows of vectors may begin outside the photo.
PAD = 8

# Rows of a work-item of sweep_similarity: windows share the sums of rows, so that more rows save additions.
ROWS = 16


def _defines(device: Device) -> dict[str, Any]:
    lanes = 8 if device.is_cpu else 1
    return {"RADIUS": SWEEP_RADIUS, "VARIANCE_MIN": SWEEP_VARIANCE_MIN, "LANES": lanes, "ROWS": ROWS}


def sweep_similarities(device: Device, photo: Array, sources: list[Array], maps: Array, planes: Array) -> Array:
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
    (2, D, H, W) real
        The two largest of the sources' normalised cross-correlations of windows, -1 to 1; -1 where there is none.
    """
    (height, width), count, defines = photo.shape, len(planes), _defines(device)
    stride = -(-width // 8) * 8 + 2 * PAD
    padded = device.empty("photo with margins", (height, stride))
    device.launch("sweep", "sweep_pad", (stride, height), [width, stride, photo, padded], defines=defines)
    windows = device.empty("windows of the photo", (2, height, stride))
    arguments: list[Any] = [width, height, stride, padded, windows]
    device.launch("sweep", "sweep_windows", (stride, height), arguments, defines=defines)
    warped = device.empty("photo on planes", (count, height, stride))
    pairs = device.empty("similarities", (2, count, height, width))
    for s, source in enumerate(sources):
        rows, columns = source.shape
        arguments = [width, height, stride, columns, rows, source, s, maps, planes, warped]
        device.launch("sweep", "sweep_warp", (stride // defines["LANES"], height, count), arguments, defines=defines)
        arguments = [width, height, stride, s, count, padded, windows, warped, pairs]
        chunks = -(-width // defines["LANES"]), -(-height // ROWS), count
        device.launch("sweep", "sweep_similarity", chunks, arguments, defines=defines)
    return pairs


def sweep_best(device: Device, pairs: Array, planes: Array) -> tuple[Array, Array]:
    """Choose the depth of each pixel.

    Parameters
    ----------
    pairs : (2, D, H, W) real
        Of `sweep_similarities`.
    planes : (D,) real
        Inverse depths, 1/world units, ascending.

    Returns
    -------
    inverse : (H, W) real
        Inverse depth with the largest score, refined between the planes, 1/world units.
    scores : (H, W) real
        Mean of the two largest similarities there; -1 where the best plane is the first or the last one.
    """
    _, count, height, width = pairs.shape
    inverse, scores = (device.empty(name, (height, width)) for name in ("inverse depths", "scores"))
    arguments: list[Any] = [height * width, count, pairs, planes, inverse, scores]
    device.launch("sweep", "sweep_best", (height * width,), arguments, defines=_defines(device))
    return inverse, scores
