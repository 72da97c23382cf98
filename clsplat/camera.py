"""Cameras in OpenCV axes: pinhole, orthographic, fisheye and equirectangular."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat import display
from clsplat.constants import FISHEYE_ANGLE_MAX, FRUSTUM_MARGIN, NEAR, NEAR_EXTENTS
from clsplat.errors import InputError, whole
from clsplat.fisheye import fisheye_angle, fisheye_radius

CameraModel = Literal["pinhole", "orthographic", "fisheye", "equirectangular"]

LAST_ROW_TOLERANCE = 1e-4
"""Largest difference of the last row of a pose from 0, 0, 0, 1: inversions round it, and finite differences vary
it. A transposed pose has its translation there."""

PARALLEL = 1e-12
"""Sine of the angle between two directions up to which rounding determines it: they are parallel."""

NEAR_MEANS = 10_000
"""Approximate number of Gaussians from which `default_near` is computed; the others are skipped."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera: x right, y down, z forward; pixel centres at +0.5.

    A point (x, y, z) in camera coordinates is projected to (fx a + cx, fy b + cy), where (a, b) is

    * pinhole: (x/z, y/z);
    * orthographic: (x, y);
    * fisheye: (x, y) theta_d/rho with rho the length of (x, y), theta = atan2(rho, z) and theta_d = theta (1 + k1
      theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (Kannala and Brandt 2006; OpenCV's and COLMAP's OPENCV_FISHEYE);
    * equirectangular: longitude atan2(x, z) and latitude atan2(y, length of (x, z)), positive downwards.

    Parameters
    ----------
    viewmat : (4, 4) float64
        World to camera, in world units; copied, and read-only.
    fx, fy : float
        Focal lengths in pixels; for orthographic cameras in pixels per world unit, for equirectangular ones in pixels
        per radian.
    cx, cy : float
        Principal point in pixels, from the upper left corner of the upper left pixel.
    width, height : int
        Image size in pixels.
    model : {"pinhole", "orthographic", "fisheye", "equirectangular"}
        Projection.
    distortion : tuple of 4 floats
        k1 to k4 of a fisheye; 0 for other models.
    near : float, optional
        Depth (for a fisheye, distance) in world units up to which nothing is drawn; positive. Default: by the
        scene's points where it is trained; by the Gaussians' `default_near` in `clsplat.render`; else 0.01.

    Raises
    ------
    InputError
        If the model is unknown, a camera other than a fisheye has a distortion, a value is not finite as float32, a
        focal length or a size is not positive, a size is not an integer, the upper left 3x3 of `viewmat` is not a
        rotation (not orthonormal to 1e-3, or a reflection), or its last row is not 0, 0, 0, 1 to 1e-4.
    """

    viewmat: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    model: CameraModel = "pinhole"
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    near: float | None = None

    def __post_init__(self) -> None:
        if self.model not in get_args(CameraModel):
            raise InputError(
                f"camera: expected a model among {', '.join(get_args(CameraModel))}, found {self.model!r}"
            )
        object.__setattr__(self, "distortion", tuple(map(float, self.distortion)))
        if len(self.distortion) != 4 or (any(self.distortion) and self.model != "fisheye"):
            raise InputError(
                "camera: expected a distortion k1, k2, k3, k4, which is 0 for models other than fisheye, found "
                f"{self.distortion} for a camera of model {self.model}"
            )
        viewmat = np.array(self.viewmat, dtype=np.float64, order="C")
        viewmat.flags.writeable = False  # what follows from it is kept
        if viewmat.shape != (4, 4):
            raise InputError(f"viewmat: expected shape (4, 4), found {viewmat.shape}")
        object.__setattr__(self, "viewmat", viewmat)
        intrinsics = np.array([self.fx, self.fy, self.cx, self.cy, *self.distortion], dtype=np.float64)
        values = np.abs(np.append(viewmat, intrinsics))
        if not (values <= np.finfo(np.float32).max).all():
            raise InputError(f"camera: expected finite viewmat and intrinsics, as float32, found {values.max()}")
        if min(self.fx, self.fy) < np.finfo(np.float32).tiny:
            raise InputError(f"camera: expected positive focal lengths, as float32, found fx={self.fx}, fy={self.fy}")
        for name in ("width", "height"):  # kernels take integers of 32 bits, and no others
            object.__setattr__(self, name, whole(name, getattr(self, name)))
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera: expected a size of at least 1x1, found {self.width}x{self.height}")
        if self.near is not None and not np.finfo(np.float32).tiny <= self.near <= np.finfo(np.float32).max:
            raise InputError(f"near: expected a positive depth, as float32, found {self.near}")
        rotation = viewmat[:3, :3]
        # 1e-3 accepts poses printed with four digits. A scaled or sheared matrix would silently render a wrong scene.
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise InputError(
                "viewmat: expected a rotation in its upper left 3x3 (orthonormal, determinant +1), found determinant "
                f"{np.linalg.det(rotation):.4g}"
            )
        if np.abs(viewmat[3] - (0, 0, 0, 1)).max() > LAST_ROW_TOLERANCE:
            raise InputError(
                f"viewmat: expected 0, 0, 0, 1 in its last row, found {display.numbers(viewmat[3])}; transpose a "
                "matrix whose translation is in its last row"
            )

    @property
    def K(self) -> NDArray[np.float64]:
        """Intrinsic matrix, (3, 3), in pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def near_depth(self) -> float:
        """Depth of the near plane, world units: `near`, or NEAR where it is not given."""
        return NEAR if self.near is None else self.near

    @cached_property
    def position(self) -> NDArray[np.float64]:
        """Camera centre in world units, (3,)."""
        return np.asarray(-np.linalg.solve(self.viewmat[:3, :3], self.viewmat[:3, 3]), dtype=np.float64)

    @cached_property
    def angle_max(self) -> float:
        """Largest angle from the axis, in radians, at which a fisheye draws a Gaussian.

        This is the angle of the image's farthest corner, enlarged by FRUSTUM_MARGIN. It is limited to
        FISHEYE_ANGLE_MAX and to the range in which the radius in the image grows with the angle.
        """
        # Coefficients that are 0 in single precision: quotients by the last of them would overflow.
        k1, k2, k3, k4 = (k if abs(k) >= np.finfo(np.float32).tiny else 0.0 for k in self.distortion)
        turns = np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])  # d theta_d/d theta, in theta^2
        turns = turns.real[(np.abs(turns.imag) < 1e-9) & (turns.real > 0)]
        most = min(FISHEYE_ANGLE_MAX, float(np.sqrt(turns.min(initial=np.inf))))
        corners = np.hypot(*np.meshgrid(self._slopes_x([0, self.width]), self._slopes_y([0, self.height])))
        return min(most, (1 + FRUSTUM_MARGIN) * float(fisheye_angle(corners.max(), self.distortion, most)))

    def _slopes_x(self, u: ArrayLike) -> NDArray[np.float64]:
        return np.asarray((np.asarray(u, dtype=np.float64) - self.cx) / self.fx)

    def _slopes_y(self, v: ArrayLike) -> NDArray[np.float64]:
        return np.asarray((np.asarray(v, dtype=np.float64) - self.cy) / self.fy)

    def rays(self, u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        """Compute the viewing directions of points in the image, in camera coordinates.

        Parameters
        ----------
        u, v : (...,)
            Points in the image, px.

        Returns
        -------
        (..., 3) float64
            Unit vectors; NaN at points of a fisheye's image to which no direction is projected.
        """
        a, b = np.broadcast_arrays(self._slopes_x(u), self._slopes_y(v))
        if self.model == "orthographic":
            return np.stack([0 * a, 0 * a, 0 * a + 1], axis=-1)
        if self.model == "equirectangular":
            return np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], axis=-1)
        if self.model == "pinhole":
            directions = np.stack([a, b, np.ones_like(a)], axis=-1)
            return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))
        radius = np.hypot(a, b)
        angle = fisheye_angle(radius, self.distortion, self.angle_max)
        angle = np.where(radius > fisheye_radius(self.angle_max, self.distortion), np.nan, angle)
        across = np.sin(angle) / np.where(radius > 0, radius, 1)
        return np.stack([a * across, b * across, np.cos(angle)], axis=-1)

    def _repr_html_(self) -> str:
        rows: dict[str, str] = {"model": self.model} if self.model != "pinhole" else {}
        if self.model in ("pinhole", "fisheye"):
            middle = self.rays([0, self.width, self.cx, self.cx], [self.cy, self.cy, 0, self.height])
            angles = np.degrees(np.arctan2(np.hypot(middle[:, 0], middle[:, 1]), middle[:, 2]))
            angles = np.where(np.isnan(angles), np.degrees(self.angle_max), angles).reshape(2, 2).sum(axis=1)
            rows["field of view"] = f"{angles[0]:.0f}° x {angles[1]:.0f}°"
        rows |= {
            "focal lengths": f"{display.numbers([self.fx, self.fy])} px",
            "principal point": f"{display.numbers([self.cx, self.cy])} px",
            "position": display.numbers(self.position),
            "viewing direction": display.numbers(self.viewmat[2, :3]),
        }
        return display.facts(f"Camera, {self.width} x {self.height} px", rows)

    @classmethod
    def look_at(cls, position: object, target: object, up: object, fx: float, width: int, height: int) -> "Camera":
        """Make a pinhole camera at `position` (3,) that looks at `target` (3,), with `up` (3,) upwards in the image.

        It has square pixels, a focal length of `fx` pixels, and the principal point at the centre of the image.

        Raises
        ------
        InputError
            If `target` is `position`, `up` is parallel to the direction between them, or the camera is not valid.
        """
        eye = np.asarray(position, dtype=np.float64)
        forward = np.asarray(target, dtype=np.float64) - eye
        if not forward.any():
            raise InputError(f"position, target: expected two points, found {display.numbers(eye)} for both")
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(up, dtype=np.float64))
        if np.linalg.norm(right) <= PARALLEL * np.linalg.norm(np.asarray(up, dtype=np.float64)):
            raise InputError(f"up: expected a direction not parallel to that from position to target, found {up}")
        right /= np.linalg.norm(right)
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        viewmat[:3, 3] = -viewmat[:3, :3] @ eye
        return cls(viewmat, fx, fx, width / 2, height / 2, width, height)

    def resized(self, width: int, height: int) -> "Camera":
        """Change the image size and scale the intrinsics, which keeps the view."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    def translated(self, offset: NDArray[np.float64]) -> "Camera":
        """Express the camera in a world whose origin is moved to `offset` (3,)."""
        viewmat = self.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ offset
        return replace(self, viewmat=viewmat)

    @classmethod
    def panorama(cls, viewmat: NDArray[np.float64], width: int) -> "Camera":
        """Make an equirectangular camera of the whole sphere: `width` pixels for 360 degrees, `width`/2 for 180."""
        height = width // 2
        return cls(
            viewmat, width / (2 * np.pi), height / np.pi, width / 2, height / 2, width, height, "equirectangular"
        )


def pixel_rays(camera: Camera) -> NDArray[np.float64]:
    """Compute the viewing directions of all pixels' centres; they are kept for the next camera with the same lens.

    Returns
    -------
    (H, W, 3) float64
        Unit vectors in camera coordinates; 0 where no direction is projected. Read-only.
    """
    size = camera.width, camera.height
    return _pixel_rays(camera.model, (camera.fx, camera.fy, camera.cx, camera.cy), camera.distortion, size)


@lru_cache(maxsize=2)
def _pixel_rays(
    model: CameraModel,
    intrinsics: tuple[float, ...],
    distortion: tuple[float, float, float, float],
    size: tuple[int, int],
) -> NDArray[np.float64]:
    fx, fy, cx, cy = intrinsics
    camera = Camera(np.eye(4), fx, fy, cx, cy, *size, model=model, distortion=distortion)
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.nan_to_num(camera.rays(u, v))
    rays.flags.writeable = False
    return rays


AXES_SPREAD_MIN = 0.003
"""Smallest mean squared sine of the angles between optical axes and their common direction at which their
intersection is used; about 3 degrees. An error e of the axes' angles moves the intersection by about e/0.05 of its
distance: by a tenth for a third of a degree."""


def focus_point(cameras: list[Camera]) -> NDArray[np.float64]:
    """Compute the point at which the cameras look: the least-squares intersection of their optical axes.

    Parameters
    ----------
    cameras : list of Camera
        At least one.

    Returns
    -------
    (3,) float64
        The point with the smallest sum of squared distances from the axes, in world units. If there is no such point
        in front of the cameras (one camera, nearly parallel axes, cameras that look away from each other): the mean
        position plus the mean viewing direction times the largest distance of a camera from the mean position (times
        1 if all cameras have the same position).

    Raises
    ------
    InputError
        If there is no camera.
    """
    if not cameras:
        raise InputError("cameras: expected at least one camera, found none")
    positions = np.array([camera.position for camera in cameras])
    directions = np.array([camera.viewmat[2, :3] for camera in cameras])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centre = positions.mean(axis=0)
    # The squared distance of p from an axis is |(I - d d^T)(p - c)|^2. Positions are relative to their mean, which
    # avoids cancellation in geo-referenced scenes. The smallest eigenvalue of `normal` is the spread of the axes.
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    normal = projectors.mean(axis=0)
    if np.linalg.eigvalsh(normal)[0] > AXES_SPREAD_MIN:
        moments = np.einsum("vij,vj->vi", projectors, positions - centre).mean(axis=0)
        focus = centre + np.linalg.solve(normal, moments)
        if np.mean(np.einsum("vi,vi->v", directions, focus - positions)) > 0:
            return focus
    return centre + directions.mean(axis=0) * (spread_of_positions(cameras) or 1.0)


POSITION_ROUNDING = 1e-12
"""Distance of cameras from their mean, as a fraction of their largest coordinate, up to which they have one position:
a position is computed from a pose with a few roundings of 1e-16 each."""


def spread_of_positions(cameras: list[Camera]) -> float:
    """Compute the largest distance of a camera from the cameras' mean position, in world units; 0 if it is rounding.

    The faces of a panorama have one position, apart from rounding.
    """
    positions = np.array([camera.position for camera in cameras])
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    return spread if spread > POSITION_ROUNDING * np.abs(positions).max() else 0.0


def default_near(means: NDArray[np.floating]) -> float:
    """Compute a depth of the near plane by the size of a scene, for cameras without one.

    Parameters
    ----------
    means : (N, 3)
        Of at least one Gaussian, world units.

    Returns
    -------
    float
        `NEAR_EXTENTS` times the median distance of the means from their median, in world units; `NEAR` if that is 0.
        Means that are not finite do not count.
    """
    some = means[:: max(1, len(means) // NEAR_MEANS)].astype(np.float64)
    some = some[np.isfinite(some).all(axis=1)]
    spread = float(np.median(np.linalg.norm(some - np.median(some, axis=0), axis=1))) if len(some) else 0.0
    return max(NEAR_EXTENTS * spread, float(np.finfo(np.float32).tiny)) if spread > 0 else NEAR
