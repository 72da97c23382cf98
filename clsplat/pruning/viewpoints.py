"""Viewpoints around a scene without known cameras, and renders of the scene as views."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, default_near
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.render import renderings
from clsplat.renderer import Renderer
from clsplat.scene import View

Array = NDArray[Any]

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Angle between neighbours of a Fibonacci lattice on the sphere, radians (Gonzalez 2010,
doi:10.1007/s11004-009-9257-x)."""

STATIONS = ((3.0, -1), (2.0, -1), (1.25, -1), (0.5, 1))
"""Distance of each station of `surround` from the centre, in radii of the scene, and its direction of view: to the
centre (-1) or outward (1). At 3 radii the field of view spans 1.7 radii to either side."""

FIELD_OF_VIEW = math.pi / 3
"""Field of view across the longer edge of an image, radians; the standard lens of a phone or a compact camera has 60
to 70 degrees."""

VIEW_SIZE = 640, 480
"""Width and height of the renders from automatic viewpoints, px."""

CANDIDATES = 28
"""Viewpoints per station, about 40 degrees apart."""

PREVIEW = 4
"""Factor by which the edges of an image are divided while candidates are compared."""

SEEN_MIN = 0.005
"""Mean alpha up to which a view counts as empty."""

COVERAGE_MIN = 0.05
"""Mean alpha below which a candidate is rejected."""

DETAIL_MIN = 0.25
"""Fraction of the 0.9 quantile of detail at its station below which a candidate is rejected (measured:
docs/howto/compact.md)."""

STATION_MIN = 0.1
"""Fraction of the best station's 0.9 quantile of detail below which a station is left out: such a station sees only
the inside of a body."""


def own_views(gaussians: Gaussians, cameras: dict[str, Camera], renderer: Renderer) -> list[View]:
    """Render the scene as views, named as the cameras are; empty views (`SEEN_MIN`) are left out."""
    pairs = zip(cameras.items(), renderings(renderer, gaussians, cameras.values()), strict=True)
    return [View(name, camera, to_uint8(r.rgb)) for (name, camera), r in pairs if r.alpha.mean() > SEEN_MIN]


def automatic_cameras(gaussians: Gaussians, renderer: Renderer) -> dict[str, Camera]:
    """Choose viewpoints for a scene without cameras: those of `surround` that show detail.

    Detail is the sum of the absolute differences between neighbouring pixels per opaque pixel. It is small from
    inside or below a scene that was photographed from outside and above.

    Returns
    -------
    dict
        Cameras of `VIEW_SIZE` by name; empty if no viewpoint shows anything.
    """
    width, height = VIEW_SIZE
    stations = surround(gaussians, CANDIDATES, width, height)
    small = [c.resized(width // PREVIEW, height // PREVIEW) for cameras in stations for c in cameras]
    details = []
    for rendering in renderings(renderer, gaussians, small):
        rgb, seen = np.clip(rendering.rgb, 0, 1), float(rendering.alpha.mean())
        differences = np.abs(np.diff(rgb, axis=0)).mean() + np.abs(np.diff(rgb, axis=1)).mean()
        details.append(differences / seen if seen > COVERAGE_MIN else 0.0)
    by_station = np.reshape(details, (len(stations), CANDIDATES))
    good = np.quantile(by_station, 0.9, axis=1, keepdims=True)
    taken = (by_station >= DETAIL_MIN * good) & (good >= STATION_MIN * good.max()) & (by_station > 0)
    return {f"station {s + 1}, direction {i + 1}": stations[s][i] for s, i in np.argwhere(taken)}


def surround(gaussians: Gaussians, count: int, width: int, height: int) -> list[list[Camera]]:
    """Place viewpoints around and within a scene without known cameras.

    At each of `STATIONS` the directions are spread evenly over the sphere (a Fibonacci lattice, turned from one
    station to the next), since the vertical is unknown. Some viewpoints are below the scene or inside a body.

    Parameters
    ----------
    gaussians : Gaussians
        At least one.
    count : int
        Number of cameras per station.
    width, height : int
        Size of the images in pixels.

    Returns
    -------
    list of lists of Camera
        Per station. The images' upper edge is towards -y, where most scenes of photogrammetry have their sky. All
        have the same near plane, which follows the size of the scene.
    """
    centre, radius = bounds(gaussians)
    near = default_near(gaussians.means)
    fx = max(width, height) / 2 / math.tan(FIELD_OF_VIEW / 2)
    y = 1 - (2 * np.arange(count) + 1) / count

    def look(station: int) -> list[Camera]:
        distance, gaze = STATIONS[station]
        turns = GOLDEN_ANGLE * np.arange(count) + 2 * math.pi * station / len(STATIONS)
        rim = np.sqrt(1 - y**2)
        eyes = centre + distance * radius * np.stack([rim * np.cos(turns), y, rim * np.sin(turns)], axis=1)
        cameras = [Camera.look_at(eye, eye + gaze * (eye - centre), (0, -1, 0), fx, width, height) for eye in eyes]
        return [replace(camera, near=near) for camera in cameras]

    return [look(station) for station in range(len(STATIONS))]


def bounds(gaussians: Gaussians) -> tuple[Array, float]:
    """Centre (3,) and radius of a scene, world units: medians of the Gaussians' positions and of their distances from
    the centre, weighted by opacity. A distant background changes neither."""
    means, weights = gaussians.means.astype(np.float64), gaussians.opacities.astype(np.float64)
    centre = np.array([_median(means[:, axis], weights) for axis in range(3)])
    radius = _median(np.linalg.norm(means - centre, axis=1), weights)
    return centre, radius if radius > 0 else float(np.exp(gaussians.log_scales.max()))


def _median(values: Any, weights: Any) -> float:
    """Weighted median: half of the weight is at or below it."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order[int(np.searchsorted(sums, sums[-1] / 2))]])
