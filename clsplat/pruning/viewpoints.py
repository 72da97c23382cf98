"""Viewpoints and renders of a scene's own, where no photos are to be had."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.render import Color, render_views
from clsplat.scene import View

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[Any]

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Between neighbours of a Fibonacci lattice on the sphere, in radians (Gonzalez 2010,
doi:10.1007/s11004-009-9257-x)."""

STATIONS = ((3.0, -1), (2.0, -1), (1.25, -1), (0.5, 1))
"""Where `surround` stands, in radii of the scene, and whether it looks to the centre (-1) or outward (1). At 3 radii
the field of view below spans 1.7 radii to either side: the scene and some of what is around it."""

FIELD_OF_VIEW = math.pi / 3
"""Of `surround`, across the longer edge, in radians: that of a phone's or a compact camera's standard lens is 60 to
70 degrees."""

VIEW_SIZE = 640, 480
"""Of the scene's own renders from automatic viewpoints, in pixels."""

CANDIDATES = 28
"""Viewpoints per station: about 40 degrees apart."""

PREVIEW = 4
"""Candidates are looked at this many times smaller."""

SEEN_MIN = 0.005
"""A view shows nothing where this fraction of an opaque image or less is seen: what is too far away is a dot."""

COVERAGE_MIN = 0.05
"""Candidates that show less than this fraction of an opaque image are not taken."""

DETAIL_MIN = 0.25
"""And those with less detail than this fraction of what is good at their station. On three scenes of others: from
below the ground and from within bodies 0 to 0.4, the plain back of a guitar 0.2 to 0.5, fronts 0.6 to 1."""

STATION_MIN = 0.1
"""A station is left out where what is good is less than this fraction of the best station's: there only the inside of
a body is to be seen."""


def own_views(
    gaussians: Gaussians,
    cameras: dict[str, Camera],
    config: RenderConfig = RenderConfig(),
    device: "Device | None" = None,
    background: Color = (0.0, 0.0, 0.0),
) -> list[View]:
    """The scene's own renders as views, by the cameras' names; those that show nothing (`SEEN_MIN`) are left out."""
    renderings = render_views(gaussians, cameras.values(), config, device, background=background)
    pairs = zip(cameras.items(), renderings, strict=True)
    return [View(name, camera, to_uint8(r.rgb)) for (name, camera), r in pairs if r.alpha.mean() > SEEN_MIN]


def automatic_cameras(
    gaussians: Gaussians,
    config: RenderConfig = RenderConfig(),
    device: "Device | None" = None,
    background: Color = (0.0, 0.0, 0.0),
) -> dict[str, Camera]:
    """Viewpoints for a scene without cameras: of `surround` those that show detail.

    Detail is the sum of the absolute differences between neighbouring pixels per opaque pixel: little from within or
    below what was only photographed from outside and above.

    Returns
    -------
    dict
        Cameras of `VIEW_SIZE` by name; empty where nothing is to be seen.
    """
    width, height = VIEW_SIZE
    stations = surround(gaussians, CANDIDATES, width, height)
    small = [c.resized(width // PREVIEW, height // PREVIEW) for cameras in stations for c in cameras]
    details = []
    for rendering in render_views(gaussians, small, config, device, background=background):
        rgb, seen = np.clip(rendering.rgb, 0, 1), float(rendering.alpha.mean())
        differences = np.abs(np.diff(rgb, axis=0)).mean() + np.abs(np.diff(rgb, axis=1)).mean()
        details.append(differences / seen if seen > COVERAGE_MIN else 0.0)
    by_station = np.reshape(details, (len(stations), CANDIDATES))
    good = np.quantile(by_station, 0.9, axis=1, keepdims=True)
    taken = (by_station >= DETAIL_MIN * good) & (good >= STATION_MIN * good.max()) & (by_station > 0)
    return {f"station {s + 1}, direction {i + 1}": stations[s][i] for s, i in np.argwhere(taken)}


def surround(gaussians: Gaussians, count: int, width: int, height: int) -> list[list[Camera]]:
    """Viewpoints around and within a scene of which no cameras are known.

    At each of `STATIONS` the directions are spread evenly over the sphere (a Fibonacci lattice, turned from one
    station to the next), since nothing says where up is: some will look at the scene from below, or stand inside of
    something.

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
        Per station. The images' upper edge is towards -y, where most scenes of photogrammetry have their sky.
    """
    centre, radius = bounds(gaussians)
    fx = max(width, height) / 2 / math.tan(FIELD_OF_VIEW / 2)
    y = 1 - (2 * np.arange(count) + 1) / count

    def look(station: int) -> list[Camera]:
        distance, gaze = STATIONS[station]
        turns = GOLDEN_ANGLE * np.arange(count) + 2 * math.pi * station / len(STATIONS)
        rim = np.sqrt(1 - y**2)
        eyes = centre + distance * radius * np.stack([rim * np.cos(turns), y, rim * np.sin(turns)], axis=1)
        return [Camera.look_at(eye, eye + gaze * (eye - centre), (0, -1, 0), fx, width, height) for eye in eyes]

    return [look(station) for station in range(len(STATIONS))]


def bounds(gaussians: Gaussians) -> tuple[Array, float]:
    """Centre and radius of a scene: the median of the Gaussians' positions by opacity, and the median distance from
    there. A background far away moves neither."""
    means, weights = gaussians.means.astype(np.float64), gaussians.opacities.astype(np.float64)
    centre = np.array([_median(means[:, axis], weights) for axis in range(3)])
    radius = _median(np.linalg.norm(means - centre, axis=1), weights)
    return centre, radius if radius > 0 else float(np.exp(gaussians.log_scales.max()))


def _median(values: Any, weights: Any) -> float:
    """Weighted median: half of the weight lies at or below it."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order[int(np.searchsorted(sums, sums[-1] / 2))]])
