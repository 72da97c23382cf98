"""Launches of the stage intervals (cl/intervals.cl)."""

from pyopencl.array import Array

from clsplat.device import Device
from clsplat.field_stages import Span


def intervals_along(
    device: Device, origins: Array, directions: Array, edges: Array, offsets: Array, span: Span
) -> tuple[Array, Array]:
    """Place a sample in each interval of rays.

    Parameters
    ----------
    origins, directions : (R, 3) real
        As for `march`. Directions have length 1.
    edges : (R, N + 1) real
        Of the intervals, in [0, 1] and ascending: 0 is the beginning of a ray, 1 its end.
    offsets : (R, N) real
        Place of each sample in its interval, in [0, 1).
    span : Span

    Returns
    -------
    points : (R N, 3) real
        In [-1, 1]: the unit cube, or the contracted ball, around 0.
    deltas : (R N,) real
        Lengths of the intervals.
    """
    rays, count = offsets.shape
    points, deltas = device.empty("points", (rays * count, 3)), device.empty("deltas", rays * count)
    scalars = [rays, count, float(span.near), float(span.far)]
    arguments = [*scalars, origins, directions, edges, offsets, points, deltas]
    device.launch("intervals", "intervals_along", (rays,), arguments, defines={"CONTRACTED": int(span.contracted)})
    return points, deltas


def intervals_resample(
    device: Device, edges: Array, weights: Array, draws: Array, padding: float, power: float, keep: bool
) -> Array:
    """Draw places of rays where intervals have weight: stratified, by the inverse of the cumulative distribution.

    Parameters
    ----------
    edges : (R, N + 1) real
        As for `intervals_along`.
    weights : (R N,) real
        At least 0.
    draws : (R, M) real
        In [0, 1): draw j of a ray is at (j + draws[j]) / M of its distribution.
    padding, power : float
        An interval has the share (weight + padding)^power. The padding is positive.
    keep : bool
        Whether the result has the edges, too.

    Returns
    -------
    (R, M) or (R, N + 1 + M) real
        Ascending.
    """
    (rays, count), drawn = edges.shape, draws.shape[1]
    result = device.empty("edges", (rays, drawn + keep * count))
    scalars = [rays, count - 1, drawn, int(keep), float(padding), float(power)]
    arguments = [*scalars, edges, weights, draws, result]
    device.launch("intervals", "intervals_resample", (rays,), arguments, defines={"CONTRACTED": 0})
    return result
