"""Near planes of photos: the depth up to which nothing is drawn, by the points that the photos show."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import NEAR_EXTENTS
from clsplat.dataset.coverage import projected
from clsplat.ranges import FLOAT32_TINY
from clsplat.scene import Scene, View

NEAR_SHARE = 0.3
"""Depth of a photo's near plane as a fraction of the depth of its nearest points. Effect: docs/stability.md."""

NEAR_QUANTILE = 0.01
"""Quantile of the depths of the points in a photo that counts as the depth of the nearest points. The nearest point
itself may be an outlier."""

NEAR_POINTS = 10_000
"""Approximate number of points from which the near plane is computed; the others are skipped."""


def near_plane(camera: Camera, points: NDArray[np.float64]) -> float | None:
    """Compute a depth of the near plane at which the points in a photo show that nothing is closer.

    Faint Gaussians close to a camera cover its whole image. Other photos may show them as parts of a wall next to the
    photographer, or not at all: a camera that stands where no photo was taken is then in a haze.

    Parameters
    ----------
    camera : Camera
    points : (P, 3)
        Sparse points of the scene, world units.

    Returns
    -------
    float or None
        Depth in world units: `NEAR_SHARE` times the depth of the nearest points in the photo. None if the photo shows
        too few points.
    """
    _, depths, inside = projected(replace(camera, near=FLOAT32_TINY), points)
    seen = depths[inside]
    if len(seen) * NEAR_QUANTILE < 1:  # the quantile would be the nearest point
        return None
    return NEAR_SHARE * float(np.quantile(seen, NEAR_QUANTILE))


def with_near_planes(scene: Scene) -> Scene:
    """Give a near plane to the cameras of a scene that have none.

    Photos that show too few points have the nearest near plane of the others, or if there is none, `NEAR_EXTENTS`.
    """
    if all(view.camera.near is not None for view in (*scene.train, *scene.test)):
        return scene
    points = scene.points[:: max(1, len(scene.points) // NEAR_POINTS)]
    found = {view.name: near_plane(view.camera, points) for view in (*scene.train, *scene.test)}
    fallback = min((near for near in found.values() if near is not None), default=NEAR_EXTENTS * scene.extent)

    def with_near(part: list[View]) -> list[View]:
        nears = [view.camera.near or found[view.name] or fallback for view in part]
        return [v.with_camera(replace(v.camera, near=n)) for v, n in zip(part, nears, strict=True)]

    return replace(scene, train=with_near(scene.train), test=with_near(scene.test))
