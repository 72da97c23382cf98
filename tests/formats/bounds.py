"""Gaussians for the tests of file formats, and the stated quantisation of each format."""

import warnings

import numpy as np
from scipy.spatial import cKDTree

from clsplat.constants import SH_C0
from clsplat.formats import save_gaussians
from clsplat.gaussians import Gaussians


def random_gaussians(n=1000, degree=3, seed=0):
    """Gaussians that every format can hold without clamping."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    sh = rng.uniform(-0.9, 0.9, (n, (degree + 1) ** 2, 3))
    means, log_scales, logits = rng.normal(size=(n, 3)), rng.uniform(-6, 0, (n, 3)), rng.normal(0, 3, n)
    return Gaussians(means, log_scales, quats, logits, sh).astype(np.float32)


def extent(x):
    return np.ptp(x, axis=0)


# Largest errors that each module states: of means, log_scales, opacities, quats (other than the largest component),
# sh of band 0, sh above. Values are stored as integers, so that the bound is half a step; a whole step where no byte
# stands for the 1 of a unit quaternion.
BOUNDS = {
    ".ply": lambda g: (0, 0, 0, 0, 0, 0),
    ".compressed.ply": lambda g: (
        extent(g.means) / 2046,
        extent(g.log_scales) / 2046,
        1 / 510,
        1 / 1446,
        extent(g.sh[:, 0]) / 510,
        1 / 64,
    ),
    ".splat": lambda g: (0, 1e-6, 1 / 510, 1 / 128, 1 / 510 / SH_C0, 0),
    ".spz": lambda g: (np.exp(np.median(g.log_scales.min(axis=1))) / 10, 1 / 32, 1 / 510, 1 / 1445, 1 / 76.5, 1 / 64),
    ".sog": lambda g: (
        extent(np.sign(g.means) * np.log1p(np.abs(g.means))) / 131070 * (1 + np.abs(g.means)),
        np.ptp(g.log_scales) / 256,
        1 / 510,
        1 / 360,
        np.ptp(g.sh[:, 0]) / 256,
        np.ptp(g.sh[:, 1:]) / 256 if g.sh_degree else 0,
    ),
    ".glb": lambda g: (0, 1e-6, 0, 0, 0, 0),
}

# What each format stores in addition: the rendering mode, the world offset, bands of sh above 0.
HOLDS = {
    ".ply": {"mode", "offset", "sh"},
    ".compressed.ply": {"mode", "offset", "sh"},
    ".splat": set(),
    ".spz": {"mode", "sh"},
    ".sog": {"mode", "offset", "sh"},
    ".glb": {"mode", "offset", "sh"},
}
SLACK = 1 + 1e-4
"""Factor on the bounds, in addition to 1e-6, since the arithmetic is float32."""


def matched(found, expected):
    """Sort the rows of `found` as those of `expected`, by position, since most formats sort."""
    distance, rows = cKDTree(found.means).query(expected.means)
    assert sorted(rows) == list(range(len(expected))), f"rows lost or doubled, at most {distance.max()} away"
    return found.take(rows)


def assert_within(found, expected, bounds):
    means, log_scales, opacities, quats, sh0, sh = (np.asarray(b) * SLACK + 1e-6 for b in bounds)
    for array in found.arrays().values():
        assert array.dtype == np.float32
    assert (np.abs(found.means - expected.means) <= means).all()
    assert (np.abs(found.log_scales - expected.log_scales) <= log_scales).all()
    assert (np.abs(found.opacities - expected.opacities) <= opacities).all()
    assert (np.abs(found.sh[:, 0] - expected.sh[:, 0]) <= sh0).all()
    assert found.sh.shape == expected.sh.shape
    assert (np.abs(found.sh[:, 1:] - expected.sh[:, 1:]) <= sh).all()
    # q and -q are the same rotation. The largest component is computed from the others: up to three times their
    # error.
    sign = np.sign(np.einsum("ni,ni->n", found.quats, expected.quats))[:, None]
    error = np.sort(np.abs(found.quats * sign - expected.quats), axis=1)
    np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1, rtol=1e-6)
    assert (error[:, :3] <= quats).all() and (error[:, 3] <= 3 * quats).all()


def save(path, gaussians, *rest):
    """Save; return the warnings of the format."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        save_gaussians(path, gaussians, *rest)
    for warning in caught:
        assert str(warning.message).startswith(f"{path}: ")
    return " ".join(str(warning.message) for warning in caught)
