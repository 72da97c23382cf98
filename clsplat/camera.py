"""Pinhole camera in OpenCV axes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat import display
from clsplat.errors import InputError


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera (x right, y down, z forward; pixel centres at +0.5).

    Parameters
    ----------
    viewmat : (4, 4) float64
        World to camera, in world units.
    fx, fy : float
        Focal lengths in pixels.
    cx, cy : float
        Principal point in pixels, from the upper left corner of the upper left pixel.
    width, height : int
        Image size in pixels.

    Raises
    ------
    InputError
        If a value is not finite as float32, a focal length or a size is not positive, or the rotation is not one
        (not orthonormal to 1e-3, or a reflection).
    """

    viewmat: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        viewmat = np.ascontiguousarray(self.viewmat, dtype=np.float64)
        if viewmat.shape != (4, 4):
            raise InputError(f"viewmat: expected shape (4, 4), found {viewmat.shape}")
        object.__setattr__(self, "viewmat", viewmat)
        intrinsics = np.array([self.fx, self.fy, self.cx, self.cy], dtype=np.float64)
        values = np.abs(np.append(viewmat, intrinsics))
        if not (values <= np.finfo(np.float32).max).all():
            raise InputError(f"camera: expected finite viewmat and intrinsics, as float32, found {values.max()}")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(f"camera: expected positive focal lengths, found fx={self.fx}, fy={self.fy}")
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera: expected a size of at least 1x1, found {self.width}x{self.height}")
        rotation = viewmat[:3, :3]
        # 1e-3 admits poses printed with four digits; a scaled or sheared matrix would render a wrong scene silently.
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise InputError(
                "viewmat: expected a rotation in its upper left 3x3 (orthonormal, determinant +1), found determinant "
                f"{np.linalg.det(rotation):.4g}"
            )

    @property
    def K(self) -> NDArray[np.float64]:
        """Intrinsic matrix, (3, 3), in pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def position(self) -> NDArray[np.float64]:
        """Camera centre in world units, (3,)."""
        return np.asarray(-np.linalg.solve(self.viewmat[:3, :3], self.viewmat[:3, 3]), dtype=np.float64)

    def _repr_html_(self) -> str:
        angles = np.degrees(2 * np.arctan2([self.width, self.height], [2 * self.fx, 2 * self.fy]))
        rows = {
            "focal lengths": f"{display.numbers([self.fx, self.fy])} px",
            "principal point": f"{display.numbers([self.cx, self.cy])} px",
            "field of view": f"{angles[0]:.0f}° x {angles[1]:.0f}°",
            "stands at": display.numbers(self.position),
            "looks along": display.numbers(self.viewmat[2, :3]),
        }
        return display.facts(f"Camera, {self.width} x {self.height} px", rows)

    @classmethod
    def look_at(cls, position: object, target: object, up: object, fx: float, width: int, height: int) -> "Camera":
        """Camera at `position` (3,) looking at `target` (3,), the image's upper edge towards `up` (3,).

        Square pixels of focal length `fx` in pixels, principal point in the middle of the image.
        """
        eye = np.asarray(position, dtype=np.float64)
        forward = np.asarray(target, dtype=np.float64) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(up, dtype=np.float64))
        right /= np.linalg.norm(right)
        viewmat = np.eye(4)
        viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        viewmat[:3, 3] = -viewmat[:3, :3] @ eye
        return cls(viewmat, fx, fx, width / 2, height / 2, width, height)

    def resized(self, width: int, height: int) -> "Camera":
        """The same view at another image size; the intrinsics follow."""
        sx, sy = width / self.width, height / self.height
        return Camera(self.viewmat, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def translated(self, offset: NDArray[np.float64]) -> "Camera":
        """The same camera in a world whose origin is moved to `offset` (3,)."""
        viewmat = self.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ offset
        return Camera(viewmat, self.fx, self.fy, self.cx, self.cy, self.width, self.height)


# Mean squared sine of the angles between the axes and their common direction, about 3 degrees. Axes wrong by an
# angle e move their intersection by about e/0.05 of its distance: a tenth of it for a third of a degree.
AXES_SPREAD_MIN = 0.003


def focus_point(cameras: list[Camera]) -> NDArray[np.float64]:
    """The point the cameras look at: least-squares intersection of their optical axes.

    Parameters
    ----------
    cameras : list of Camera
        At least one.

    Returns
    -------
    (3,) float64
        The point with the smallest sum of squared distances from the axes, in world units. Where there is no
        such point in front of the cameras (one camera, nearly parallel axes, cameras that look away from each
        other), the mean position plus the mean viewing direction times the largest distance of a camera from
        that mean (times 1 where all cameras stand at one place).

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
    # The squared distance of p from an axis is |(I - d d^T)(p - c)|^2; positions count from their mean because
    # those of a geo-referenced scene would cancel. The smallest eigenvalue of `normal` is the axes' spread.
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    normal = projectors.mean(axis=0)
    if np.linalg.eigvalsh(normal)[0] > AXES_SPREAD_MIN:
        moments = np.einsum("vij,vj->vi", projectors, positions - centre).mean(axis=0)
        focus = centre + np.linalg.solve(normal, moments)
        if np.mean(np.einsum("vi,vi->v", directions, focus - positions)) > 0:
            return focus
    spread = float(np.linalg.norm(positions - centre, axis=1).max())
    return centre + directions.mean(axis=0) * (spread if spread > 0 else 1.0)
