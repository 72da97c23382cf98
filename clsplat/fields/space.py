"""The space of a field: where it lies in the world, and how its rays are sampled."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, focus_point
from clsplat.errors import InputError
from clsplat.field_stages import Marching, Span
from clsplat.scene import View

NEAR_FACTOR = 8 / 3
"""Distance at which rays begin where there is a background, in near planes of the camera with the nearest one. Where
a dataset has points, that is 0.8 of the depth of the nearest points (`clsplat.dataset.near_planes`): rays that begin
closer to the cameras learn a haze in front of each. Effect: docs/howto/fields.md."""

BOX_SHARE = 0.375
"""Half edge of the cube of a scene without a background, as a fraction of the cameras' mean distance from the point
they look at: 1.5 for NeRF-synthetic scenes, whose cameras are 4 away (Mildenhall et al. 2020)."""

STEP = 3**0.5 / 1024
"""Length of a step in the unit cube: 1024 along its diagonal (Müller et al. 2022, appendix E)."""

CONE = 1 / 64
"""Length of a step per distance up to a distance of 1, where there is a background, and its contracted length beyond.
The paper has 1/256 per distance everywhere (Müller et al. 2022, appendix E), with seven times as many samples on a
ray."""

FAR = 100.0
"""Distance at which rays end where there is a background, in distances of the farthest camera from the centre. The
contraction maps it to 1.99 of 2. Where rays begin farther away, the distances are in those at which they begin."""

CUBE_EDGE = 3.0
"""Edge of the cube in the units of NeRF's synthetic scenes (Mildenhall et al. 2020)."""

CUBE_FAR = 1e6
"""Distance at which rays end without a background, in edges of the cube, unless they leave it before."""


@dataclass(frozen=True)
class Space:
    """Field coordinates: (x - centre) / scale + shift for a point x of the world.

    Without `contracted` the field is the unit cube. With it, the unit ball around 0 has the cameras in it, and the
    space around it is contracted. `pixel` is the width of a pixel of the photos at the centre, the median of all
    photos, in field coordinates.
    """

    centre: NDArray[np.float64]
    scale: float
    contracted: bool
    near: float
    pixel: float

    @classmethod
    def of(cls, views: list[View]) -> "Space":
        """The space of a scene: a cube if its photos are transparent around an object, otherwise all space.

        Parameters
        ----------
        views : list of View
            The training photos, loaded with random backgrounds, which keeps their transparency.
        """
        cameras = [view.camera for view in views]
        centre = focus_point(cameras)
        distances = [float(np.linalg.norm(camera.position - centre)) for camera in cameras]
        is_object = transparent(views)
        near = 0.0 if is_object else NEAR_FACTOR * min(camera.near_depth for camera in cameras)
        if near >= FAR * max(distances):  # cameras in one place, as on a tripod: rays would end before they begin
            distances = [near] * len(cameras)
        pixel = float(np.median([d * _spacing(camera) for camera, d in zip(cameras, distances, strict=True)]))
        if is_object:
            scale = 2 * BOX_SHARE * float(np.mean(distances))
            return cls(centre, scale, False, 0.0, pixel / scale)
        scale = max(distances)
        return cls(centre, scale, True, near / scale, pixel / scale)

    @property
    def marching(self) -> Marching:
        """Sampling of the rays of fields that have a grid of occupied cells."""
        if not self.contracted:
            return Marching(STEP, 0.0, 0.0, CUBE_FAR, False)
        return Marching(2 * STEP, CONE, self.near, FAR, True)  # the unit ball is two wide

    @property
    def edge(self) -> float:
        """Edge of the grid around the field, in field coordinates: the contracted space is four wide."""
        return 4.0 if self.contracted else 1.0

    @property
    def density_scale(self) -> float:
        """Factor on the densities of networks: the length of a unit in the units of the papers."""
        return 1.0 if self.contracted else CUBE_EDGE

    @property
    def span(self) -> Span:
        """Range of the intervals of rays."""
        return Span(self.near, FAR if self.contracted else CUBE_FAR, self.contracted)

    def rays(self, camera: Camera, u: NDArray[np.float64], v: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Origins and directions (R, 3) of the rays through points of an image, in px, in the field's coordinates.

        A direction is NaN where a fisheye sees nothing.

        Raises
        ------
        InputError
            If the camera is orthographic: its rays have no origin in common.
        """
        if camera.model == "orthographic":
            raise InputError("camera: expected a perspective one for a field, found an orthographic one")
        directions = camera.rays(u, v) @ camera.viewmat[:3, :3]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)  # poses may be printed with few digits
        origin = (camera.position - self.centre) / self.scale + (0.0 if self.contracted else 0.5)
        return np.broadcast_to(origin, directions.shape), directions

    @staticmethod
    def radii(camera: Camera, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Radii (R,) of the cones of pixels at a distance of 1, for points of an image as for `rays`.

        A disc with this radius has the variance of a pixel (Barron et al. 2021, section 3.1). It is 0 where a fisheye
        sees nothing.
        """
        widths = np.linalg.norm(camera.rays(u + 1, v) - camera.rays(u, v), axis=1)
        return np.nan_to_num(widths) * 2 / 12**0.5


def transparent(views: list[View]) -> bool:
    """Whether the background is visible in a pixel of the photos. A channel alpha alone does not tell."""
    return any(view.clear is not None and view.clear.any() for view in views)


def _spacing(camera: Camera) -> float:
    """Distance of neighbouring rays in the middle of an image, at a distance of 1."""
    u, v = np.array([[camera.width / 2], [camera.height / 2]])
    return float(np.linalg.norm(camera.rays(u + 1, v) - camera.rays(u, v)))
