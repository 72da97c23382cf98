"""Twin of the stage march."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import Marching, Samples

Array = NDArray[Any]


def contract(points: Array) -> Array:
    """Map space to the ball of radius 2, and the unit ball to itself (Barron et al. 2022, equation 10); (..., 3)."""
    norms = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1)
    return (2 - 1 / norms) * points / norms


def march(origins: Array, directions: Array, offsets: Array, occupied: Array, marching: Marching) -> Samples:
    """Find the samples of rays. Arguments and result as for `clsplat.ops.march`."""
    positions, deltas, counts = [np.zeros((0, 3))], [], []
    for origin, direction, offset in zip(origins, directions, offsets, strict=True):
        near, far = marching.near, marching.far
        if not marching.contracted:
            for o, d in zip(origin, direction, strict=True):
                if d != 0:
                    near, far = max(near, min(-o / d, (1 - o) / d)), min(far, max(-o / d, (1 - o) / d))
                elif not 0 <= o <= 1:
                    far = near
        own: list[float] = []
        t = near + offset * _step(near, marching)
        while t < far and t not in own[-1:]:  # a step may be lost in rounding
            own.append(t)
            t += _step(t, marching)
        steps = [_step(t, marching) for t in own]
        x, ends = (origin + np.array(at)[:, None] * direction for at in (own, np.add(own, steps)))
        if marching.contracted:
            steps = np.linalg.norm(contract(ends) - contract(x), axis=1)
            x = contract(x) / 4 + 0.5
        cells = np.clip((x * len(occupied)).astype(int), 0, len(occupied) - 1)
        kept = occupied[cells[:, 2], cells[:, 1], cells[:, 0]] != 0
        positions.append(x[kept])
        deltas += [step for step, keep in zip(steps, kept, strict=True) if keep]
        counts.append(int(kept.sum()))
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.uint32)
    rays_of = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
    return Samples(np.concatenate(positions), np.array(deltas), rays_of, first, int(first[-1]))


def _step(t: float, marching: Marching) -> float:
    return max(marching.step, marching.cone * t * (max(t, 1) if marching.contracted else 1))
