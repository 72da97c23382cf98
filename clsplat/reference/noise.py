"""Twin of the stage noise."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import QUAT_NORM2_MIN
from clsplat.gaussians import Gaussians, sigmoid
from clsplat.reference.project import rotations
from clsplat.stages import GATE_OPACITY, GATE_SLOPE

Array = NDArray[Any]


def add_noise(gaussians: Gaussians, size: float, seed: int, iteration: int) -> None:
    """Add noise to the means, in place. Arguments as for `clsplat.ops.add_noise`."""
    g = gaussians.astype(np.float64)
    counters = np.zeros((len(g), 4), np.uint32)
    counters[:, 0], counters[:, 1] = np.arange(len(g)), iteration
    eta = normals(philox(counters, (seed & 0xFFFFFFFF, seed >> 32)))
    gate = sigmoid(-GATE_SLOPE * (sigmoid(g.logit_opacities) - GATE_OPACITY))
    norms = np.linalg.norm(g.quats, axis=1)
    usable = norms**2 >= QUAT_NORM2_MIN
    axes = rotations(g.quats / np.where(usable, norms, 1)[:, None])
    step = np.einsum("nij,nj,nkj,nk->ni", axes, np.exp(2 * g.log_scales), axes, eta)
    gaussians.means[usable] += (size * gate[:, None] * step)[usable]


def philox(counters: Array, key: tuple[int, int]) -> Array:
    """Philox4x32-10 (Salmon et al. 2011, section 3.3): random (N, 4) uint32 from counters (N, 4) and a 64-bit key."""
    a, b, c, d = (column.astype(np.uint64) for column in counters.T)
    low, shift = np.uint64(0xFFFFFFFF), np.uint64(32)
    k0, k1 = key
    for _ in range(10):
        first, second = np.uint64(0xD2511F53) * a, np.uint64(0xCD9E8D57) * c
        a, b = (second >> shift) ^ b ^ np.uint64(k0), second & low
        c, d = (first >> shift) ^ d ^ np.uint64(k1), first & low
        k0, k1 = (k0 + 0x9E3779B9) & 0xFFFFFFFF, (k1 + 0xBB67AE85) & 0xFFFFFFFF
    return np.stack([a, b, c, d], axis=1).astype(np.uint32)


def normals(bits: Array) -> Array:
    """Standard normal numbers (N, 3) from random bits (N, 4) uint32 (Box and Muller 1958)."""
    u = (bits + 0.5) / 2**32
    radii = np.sqrt(-2 * np.log(u[:, [0, 0, 2]]))
    radii *= np.cos(2 * np.pi * (u[:, [1, 1, 3]] - [0, 0.25, 0]))
    return radii
