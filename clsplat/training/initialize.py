"""The first Gaussians: one per sparse point, or random ones where there are no points."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera, focus_point
from clsplat.config import InitConfig
from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, logit
from clsplat.randomness import stream
from clsplat.ranges import FLOAT32_MAX, check
from clsplat.scene import Scene

NEIGHBOURS = 3
"""Number of neighbours whose mean squared distance is a Gaussian's first variance (original)."""

OPACITY = 0.1
"""Default opacity of the first Gaussians (original)."""

RANDOM_POINTS = 100_000
"""Default number of Gaussians of a random start (original)."""

VARIANCE_SHARE = 1e-4
"""Smallest first variance, as a fraction of their median; without it, duplicate points would have scale 0. The
original's is 1e-7 squared world units, about the same for scenes of a few units."""


def initialize(scene: Scene, config: InitConfig, seed: int, cap: int | None = None) -> Gaussians:
    """Make the first Gaussians: `from_points` if the scene has points, otherwise `random`.

    Parameters
    ----------
    scene : Scene
        Its points and training cameras are used.
    config : InitConfig
        Opacity, degree of the spherical harmonics, number and extent of random Gaussians.
    seed : int
        Seed of the random Gaussians and of the choice of points.
    cap : int, optional
        Largest number of Gaussians; of more points, this number is drawn.

    Returns
    -------
    Gaussians
        float32, on the host.
    """
    n = start_count(scene, config, cap)
    if not len(scene.points):
        return random([view.camera for view in scene.train], replace(config, random_points=n), seed)
    rows = np.arange(n)
    if n < len(scene.points):
        rows = np.sort(stream(seed, "points of the start").permutation(len(scene.points))[:n])
    return from_points(scene.points[rows], scene.colors[rows], config)


def start_count(scene: Scene, config: InitConfig, cap: int | None) -> int:
    """Number of Gaussians that `initialize` makes."""
    wanted = len(scene.points) or _random_points(config)
    return wanted if cap is None else min(wanted, cap)


def _random_points(config: InitConfig) -> int:
    return RANDOM_POINTS if config.random_points is None else config.random_points


def from_points(points: ArrayLike, colors: ArrayLike, config: InitConfig) -> Gaussians:
    """Make one isotropic Gaussian per point, as large as the distance to its neighbours (paper, section 5.1).

    Parameters
    ----------
    points : (P, 3)
        In world units, near the origin; P at least 1.
    colors : (P, 3) uint8
        Colours of the points.
    config : InitConfig
        Opacity and degree of the spherical harmonics.

    Returns
    -------
    Gaussians
        P Gaussians, float32. Their standard deviation is the root mean square distance to the 3 nearest other points
        (to all others if there are fewer), and 1 for a single point.

    Raises
    ------
    InputError
        If shapes differ, there is no point, one is not finite, or a setting is out of range.
    """
    check(config, "init.")
    means = np.asarray(points, dtype=np.float64)
    rgb = np.asarray(colors)
    if means.ndim != 2 or means.shape[1] != 3 or not len(means):
        raise InputError(f"points: expected at least one point, shape (P, 3), found shape {means.shape}")
    if not (np.abs(means) <= FLOAT32_MAX).all():
        raise InputError(f"points: expected finite coordinates, as float32, found {np.abs(means).max():.3g}")
    if rgb.shape != means.shape or rgb.dtype != np.uint8:
        raise InputError(f"colors: expected shape {means.shape} of uint8, found {rgb.shape} of {rgb.dtype}")
    return _gaussians(means, _variances(means), rgb / 255, config)


def random(cameras: list[Camera], config: InitConfig, seed: int) -> Gaussians:
    """Make Gaussians with random positions and colours in a box around the point that the cameras look at.

    Parameters
    ----------
    cameras : list of Camera
        The training cameras; at least one.
    config : InitConfig
        Number, size of the box, opacity and degree of the spherical harmonics.
    seed : int
        Seed of positions and colours.

    Returns
    -------
    Gaussians
        `config.random_points` Gaussians (default: RANDOM_POINTS), float32. Positions are uniform in a cube around
        `focus_point`, whose half edge is `config.random_extent` times the cameras' mean distance from it. Scales are
        as in `from_points`.

    Raises
    ------
    InputError
        If there is no camera, or a setting is out of range.
    """
    check(config, "init.")
    n = _random_points(config)
    focus = focus_point(cameras)
    distance = float(np.mean([np.linalg.norm(camera.position - focus) for camera in cameras]))
    half = config.random_extent * distance
    rng = stream(seed, "initial points")
    means = focus + rng.uniform(-half, half, (n, 3))
    return _gaussians(means, _variances(means), rng.uniform(size=means.shape), config)


def _variances(points: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.spatial import cKDTree

    neighbours = min(NEIGHBOURS, len(points) - 1)
    if neighbours == 0:
        return np.ones(1)
    # A tree cannot divide equal points, and would search all of them for each: it holds as many as can be neighbours.
    places, rows, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    tree = cKDTree(np.repeat(places, np.minimum(counts, neighbours + 1), axis=0))
    # The nearest point is the point itself, or a duplicate of it at the same distance 0.
    distances, _ = tree.query(places, k=neighbours + 1, workers=-1)
    variances = np.mean(distances[:, 1:] ** 2, axis=1)[rows.ravel()]
    median = np.median(variances[variances > 0]) if variances.any() else 1.0
    return np.maximum(variances, VARIANCE_SHARE * median)


def _gaussians(
    means: NDArray[np.float64], variances: NDArray[np.float64], rgb: NDArray[np.float64], config: InitConfig
) -> Gaussians:
    """Isotropic Gaussians; `rgb` (N, 3) in [0, 1]."""
    opacity = OPACITY if config.opacity is None else config.opacity
    count = len(means)
    sh = np.zeros((count, (config.sh_degree + 1) ** 2, 3))
    sh[:, 0] = (rgb - 0.5) / SH_C0
    return Gaussians(
        means=means,
        log_scales=np.repeat(0.5 * np.log(variances)[:, None], 3, axis=1),
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        logit_opacities=np.full(count, logit(np.array(opacity))),
        sh=sh,
    ).astype(np.float32)
