"""Twin of the stage sweep."""

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from clsplat.constants import SWEEP_RADIUS, SWEEP_VARIANCE_MIN

Array = NDArray[Any]


def sweep_scores(photo: Array, sources: list[Array], maps: Array, planes: Array) -> Array:
    """Compare photos on planes. Arguments and result as for `clsplat.ops.sweep_scores`."""
    height, width = photo.shape
    size, r = 2 * SWEEP_RADIUS + 1, SWEEP_RADIUS
    found = np.full((len(sources), len(planes), height, width), -1.0)
    if min(height, width) < size:
        return found[0]
    for s, d in np.ndindex(len(sources), len(planes)):
        b, inside = _seen_through(sources[s], maps[s], planes[d], height, width)
        windows_a, windows_b = (sliding_window_view(image, (size, size)) for image in (photo, b))
        mean_a, mean_b = windows_a.mean(axis=(2, 3)), windows_b.mean(axis=(2, 3))
        off_a, off_b = windows_a - mean_a[:, :, None, None], windows_b - mean_b[:, :, None, None]
        var_a, var_b = (off_a**2).mean(axis=(2, 3)), (off_b**2).mean(axis=(2, 3))
        least = SWEEP_VARIANCE_MIN
        similarity = (off_a * off_b).mean(axis=(2, 3)) / np.sqrt(np.maximum(var_a, least) * np.maximum(var_b, least))
        known = sliding_window_view(inside, (size, size)).all(axis=(2, 3)) & (var_a >= least)
        found[s, d, r : height - r, r : width - r] = np.where(known, similarity, -1)
    return np.sort(found, axis=0)[-2:].mean(axis=0)


def _seen_through(source: Array, mapping: Array, plane: float, height: int, width: int) -> tuple[Array, Array]:
    """The source as the photo's pixels see it through a plane, bilinear, and where it shows them."""
    rows, columns = source.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    u, v, z = np.einsum("ij,jyx->iyx", mapping[:9].reshape(3, 3), [x, y, np.ones_like(x)]) + (
        plane * mapping[9:, None, None]
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = u / z - 0.5, v / z - 0.5
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    left, top = np.minimum(u.astype(int), columns - 2), np.minimum(v.astype(int), rows - 2)
    right, low = u - left, v - top
    upper = (1 - right) * source[top, left] + right * source[top, left + 1]
    lower = (1 - right) * source[top + 1, left] + right * source[top + 1, left + 1]
    return np.where(inside, (1 - low) * upper + low * lower, 0), inside


def sweep_best(scores: Array, planes: Array) -> tuple[Array, Array]:
    """Choose depths. Arguments and result as for `clsplat.ops.sweep_best`."""
    best = scores.argmax(axis=0)
    inner = (best > 0) & (best < len(planes) - 1)
    middle = np.clip(best, 1, max(1, len(planes) - 2))
    y, x = np.indices(best.shape)
    if len(planes) < 3:
        return planes[best], np.full(best.shape, -1.0)
    before, most, after = (scores[middle + k, y, x] for k in (-1, 0, 1))
    bend = before - 2 * most + after
    shift = np.where(inner & (bend < 0), 0.5 * (before - after) / np.where(bend < 0, bend, 1), 0)
    gap = np.where(shift < 0, planes[middle] - planes[middle - 1], planes[middle + 1] - planes[middle])
    return planes[best] + shift * gap, np.where(inner, most, -1)
