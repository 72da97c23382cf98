"""The Gaussians that training starts from: one per sparse point, or random ones where there are no points."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera, focus_point
from clsplat.config import InitConfig
from clsplat.constants import SH_C0
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, logit
from clsplat.randomness import stream
from clsplat.scene import Scene

NEIGHBOURS = 3
"""Neighbours whose mean squared distance is a Gaussian's first variance (original)."""

OPACITY = 0.1
"""A Gaussian's first opacity where the configuration says none (original)."""

RANDOM_POINTS = 100_000
"""Gaussians of a random start whose number nobody names (original)."""

VARIANCE_MIN = 1e-7
"""Smallest such variance, in squared world units: duplicates would otherwise start with scale 0 (original)."""


def initialize(scene: Scene, config: InitConfig, seed: int, cap: int | None = None) -> Gaussians:
    """Gaussians to start from: `from_points` where the scene has points, otherwise `random`.

    Parameters
    ----------
    scene : Scene
        Its points and training cameras are used.
    config : InitConfig
        Opacity, degree of the spherical harmonics, number and extent of random Gaussians.
    seed : int
        Of the random ones, and of the choice of points.
    cap : int, optional
        The most Gaussians: of more points, so many are drawn.

    Returns
    -------
    Gaussians
        float32, on the host.

    Raises
    ------
    InputError
        If the cap is not positive.
    """
    if cap is not None and cap < 1:
        raise InputError(f"--max-gaussians: expected at least 1, found {cap}")
    n = start_count(scene, config, cap)
    if not len(scene.points):
        return random([view.camera for view in scene.train], replace(config, random_points=n), seed)
    rows = np.arange(n)
    if n < len(scene.points):
        rows = np.sort(stream(seed, "points of the start").permutation(len(scene.points))[:n])
    return from_points(scene.points[rows], scene.colors[rows], config)


def start_count(scene: Scene, config: InitConfig, cap: int | None) -> int:
    """How many Gaussians `initialize` makes."""
    wanted = len(scene.points) or _random_points(config)
    return wanted if cap is None else min(wanted, cap)


def _random_points(config: InitConfig) -> int:
    return RANDOM_POINTS if config.random_points is None else config.random_points


def from_points(points: ArrayLike, colors: ArrayLike, config: InitConfig) -> Gaussians:
    """One isotropic Gaussian per point, as large as the distance to its neighbours (paper, section 5.1).

    Parameters
    ----------
    points : (P, 3)
        In world units, near the origin; P at least 1.
    colors : (P, 3) uint8
        Their colours.
    config : InitConfig
        Opacity and degree of the spherical harmonics.

    Returns
    -------
    Gaussians
        P of them, float32. The standard deviation is the root mean square distance to the 3 nearest other points, to
        fewer where there are fewer, and 1 for a single point.

    Raises
    ------
    InputError
        If shapes differ, there is no point, or one is not finite.
    """
    means = np.asarray(points, dtype=np.float64)
    rgb = np.asarray(colors)
    if means.ndim != 2 or means.shape[1] != 3 or not len(means) or not np.isfinite(means).all():
        raise InputError(f"points: expected at least one finite point, shape (P, 3), found shape {means.shape}")
    if rgb.shape != means.shape or rgb.dtype != np.uint8:
        raise InputError(f"colors: expected shape {means.shape} of uint8, found {rgb.shape} of {rgb.dtype}")
    return _gaussians(means, _variances(means), rgb / 255, config)


def random(cameras: list[Camera], config: InitConfig, seed: int) -> Gaussians:
    """Gaussians of random positions and colours in a box around the point that the cameras look at.

    Parameters
    ----------
    cameras : list of Camera
        The training cameras; at least one.
    config : InitConfig
        Number, size of the box, opacity and degree of the spherical harmonics.
    seed : int
        The same seed gives the same Gaussians.

    Returns
    -------
    Gaussians
        `config.random_points` of them, RANDOM_POINTS where that is None, float32, uniform in the cube around
        `focus_point` whose half edge is `config.random_extent` times the cameras' mean distance from it; sized as by
        `from_points`.

    Raises
    ------
    InputError
        If there is no camera, or the number or size is not positive.
    """
    n = _random_points(config)
    if n < 1 or not config.random_extent > 0:
        raise InputError(
            f"random_points, random_extent: expected positive values, found {n} and {config.random_extent}"
        )
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
    # The nearest point is the point itself, or a duplicate of it at the same distance 0.
    distances, _ = cKDTree(points).query(points, k=neighbours + 1, workers=-1)
    return np.maximum(np.mean(distances[:, 1:] ** 2, axis=1), VARIANCE_MIN)


def _gaussians(
    means: NDArray[np.float64], variances: NDArray[np.float64], rgb: NDArray[np.float64], config: InitConfig
) -> Gaussians:
    """Isotropic Gaussians; `rgb` (N, 3) in [0, 1]."""
    opacity = OPACITY if config.opacity is None else config.opacity
    if not 0 < opacity < 1:
        raise InputError(f"opacity: expected a value between 0 and 1, found {opacity}")
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
