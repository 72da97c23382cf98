"""Scenes: photos with their cameras, and sparse points, as `clsplat.dataset` loads them."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat import display
from clsplat.camera import Camera, spread_of_positions
from clsplat.errors import InputError

Color = tuple[float, float, float]

DISPARITY_MIN = 1e-6
"""Least inverse depth of a map, as a fraction of its largest: far beyond what photos of a scene resolve."""

DIGEST_BYTES = 16
"""Length of a digest: among 10^12 photos, the chance that two of them share one is 10^-15."""

THUMBNAILS = 8
"""Approximate number of photos that a notebook shows of a scene."""


def check_color(name: str, color: Any) -> None:
    """Raise an InputError, which names the argument, if a colour is not three finite numbers."""
    try:
        usable = np.shape(color) == (3,) and bool(np.isfinite(np.asarray(color, np.float64)).all())
    except (TypeError, ValueError):
        usable = False
    if not usable:
        raise InputError(f"{name}: expected three finite numbers, RGB, found {color!r:.60}")


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths that were measured or estimated for a photo, up to a scale and a shift.

    The inverse depth of a pixel, 1/world units, is ``scale * value + shift``, or if the values grow with the depth,
    ``1 / (scale * value + shift)``. Depth is as rendered: z, and for fisheyes and whole panoramas the distance.

    Parameters
    ----------
    values : (H, W) float32
        Values of the file; NaN where the depth is unknown.
    inverse : bool
        Whether the values fall with the depth.
    scale, shift : float
        Scale and shift, which `clsplat.dataset.depth_maps.aligned` finds. By default, `values` are depths in world
        units.
    """

    values: NDArray[np.float32]
    inverse: bool = False
    scale: float = 1.0
    shift: float = 0.0

    @cached_property
    def disparities(self) -> NDArray[np.float32]:
        """Inverse depths (H, W), 1/world units; 0 where the map knows none."""
        values = self.scale * self.values.astype(np.float64) + self.shift
        if self.inverse:
            # Beyond infinity, by an error of the fit: as far away as a number tells, but not unknown.
            least = DISPARITY_MIN * np.nanmax(values, initial=0)
            known = np.where(np.isnan(values), 0, np.maximum(values, least))
        else:
            known = np.divide(1, values, out=np.zeros_like(values), where=values > 0)
        return known.astype(np.float32)

    @cached_property
    def unit(self) -> float:
        """Median of the inverse depths, 1/world units; 0 if the map knows none."""
        known = self.disparities[self.disparities > 0]
        return float(np.median(known)) if known.size else 0.0


@dataclass(frozen=True, eq=False)
class View:
    """A photo and its camera.

    Parameters
    ----------
    name : str
        Path of the photo inside its folder, with forward slashes.
    camera : Camera
        Pinhole, fisheye or, of a whole panorama, equirectangular camera of the photo's size, in the coordinates of
        the scene.
    image : (H, W, 3) uint8
        The photo, RGB, composited on the background where it was transparent. It is undistorted unless the camera is
        a fisheye or a panorama. It is upright if its camera was recovered by clsplat; otherwise as its file stores
        it, unless only the upright photo has the camera's size.
    mask : (H, W) bool, optional
        True where pixels are used.
    clear : (H, W) uint8, optional
        Visible share of the background, 0 to 255, if the photo is transparent and training uses random backgrounds.
    depth : DepthMap, optional
        Depths of its pixels, which training compares with those of the scene.
    """

    name: str
    camera: Camera
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None = None
    clear: NDArray[np.uint8] | None = None
    depth: DepthMap | None = None

    def on(self, background: Color, loaded_on: Color) -> NDArray[np.uint8]:
        """Composite the photo (H, W, 3) on another background than that of loading; both are RGB in [0, 1]."""
        if self.clear is None:
            return self.image
        change = self.clear[:, :, None] * (np.array(background) - np.array(loaded_on))
        return np.rint(np.clip(self.image + change, 0, 255)).astype(np.uint8)

    # What follows differs for a photo that is read when it is needed (`clsplat.streaming.StreamedView`).

    def loaded(self) -> "View":
        """The view with its arrays in memory."""
        return self

    def prefetch(self) -> None:
        """Begin to read the photo, which will be needed soon."""

    @property
    def ahead(self) -> int:
        """Number of photos to `prefetch` while one is used; 0 for photos in memory."""
        return 0

    def with_camera(self, camera: Camera) -> "View":
        """The photo with another camera."""
        return replace(self, camera=camera)

    def with_depth(self, depth: DepthMap | None) -> "View":
        """The photo with a depth map, or with none."""
        return replace(self, depth=depth)

    def changed(
        self, change: "Callable[[View], View]", camera: Camera | None = None, *, masks: bool = False
    ) -> "View":
        """The view that `change` makes of this one, now or when it is needed.

        `camera` is that of the result; `masks`: whether it has a mask if this one has none. Some of its pixels count
        if some of this one do, and it has a depth map if this one has.
        """
        return change(self)

    @property
    def counts(self) -> NDArray[np.bool_]:
        """(H, W), whether a pixel counts."""
        return np.ones((self.camera.height, self.camera.width), bool) if self.mask is None else self.mask

    @property
    def is_used(self) -> bool:
        """Whether any pixel counts."""
        return self.mask is None or bool(self.mask.any())

    @property
    def digests(self) -> tuple[str, str] | None:
        """Digests of the pixels and of the mask (empty without one); None as long as the photo has not been read."""
        pixels = digest(self.image) if self.clear is None else digest(self.image, self.clear)
        return pixels, "" if self.mask is None else digest(self.mask)

    def expect(self, digests: tuple[str, str]) -> None:
        """Demand that a photo that has not been read has these digests; otherwise reading it is an InputError."""


def digest(*arrays: NDArray[Any]) -> str:
    """Digest of arrays, their shapes and types."""
    result = blake2b(digest_size=DIGEST_BYTES)
    for array in arrays:
        result.update(f"{array.dtype.str}{array.shape}".encode())
        result.update(np.ascontiguousarray(array).data)
    return result.hexdigest()


def in_turn(views: Iterable[View]) -> Iterator[View]:
    """Yield views in their order with their arrays in memory, while the next ones are being read."""
    views = list(views)
    for k, view in enumerate(views):
        for later in views[k : k + 1 + view.ahead]:
            later.prefetch()
        yield view.loaded()


@dataclass(frozen=True, eq=False)
class Scene:
    """Views and points in one coordinate system.

    Parameters
    ----------
    train, test : list of View
        Training photos and held-out photos, each sorted by name.
    points : (P, 3) float64
        Sparse points in the coordinates of the scene; P may be 0.
    colors : (P, 3) uint8
        RGB of the points.
    offset : (3,) float64
        Offset that was subtracted from the world's coordinates, in world units; zero unless the cameras are far from
        the origin, as in geo-referenced scenes.
    downscale : int
        Factor by which the edges of the photos were divided.
    shown : mapping of str to (N,) int
        Rows of the points whose features a photo has, by its name; empty if they are not known.
    gains : mapping of str to (3,) float64
        Factors by which training divides the colours of training photos, by name (`clsplat.dataset.brightness`).
    """

    train: list[View]
    test: list[View]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    downscale: int = 1
    shown: Mapping[str, NDArray[np.intp]] = field(default_factory=dict)
    gains: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    @property
    def extent(self) -> float:
        """Scale of the scene in world units: 1.1 times the largest distance of a training camera from their mean.

        This is `cameras_extent` of the original implementation; 1 if all cameras have the same position.
        """
        return 1.1 * spread_of_positions([view.camera for view in self.train]) or 1.0

    def _repr_html_(self) -> str:
        views = [*self.train, *self.test]
        rows = {
            "photos": f"{len(self.train)} to train on, {len(self.test)} held out",
            "sizes": ", ".join(sorted({f"{v.camera.width} x {v.camera.height}" for v in views})),
            "masks": str(sum(v.mask is not None for v in views)),
            "points": f"{len(self.points):,}",
        }
        if any(v.depth is not None for v in views):
            rows["depth maps"] = str(sum(v.depth is not None for v in views))
        if self.offset.any():
            rows["offset"] = display.numbers(self.offset)
        if not views:
            return display.facts("Scene", rows)
        rows["extent"] = f"{self.extent:.3g}" if self.train else ""
        eyes = np.array([v.camera.position for v in views])
        gazes = np.array([v.camera.viewmat[2, :3] for v in views])
        up = -np.mean([v.camera.viewmat[1, :3] for v in views], axis=0)
        # Any axis perpendicular to up is possible; with this one, the first camera's right is to the right in the
        # plan.
        east = views[0].camera.viewmat[0, :3] - up * (views[0].camera.viewmat[0, :3] @ up) / max(up @ up, 1e-12)
        ground = np.stack([east, np.cross(up, east)])
        ground /= np.maximum(np.linalg.norm(ground, axis=1, keepdims=True), 1e-12)
        held_out = np.arange(len(views)) >= len(self.train)
        plan = display.plan(eyes @ ground.T, gazes @ ground.T, held_out, self.points @ ground.T, self.colors)
        chosen = self.train[:: -(-len(self.train) // THUMBNAILS) or 1] or self.test[:THUMBNAILS]
        photos = "".join(display.thumbnail(view.image, view.name) for view in chosen)
        return display.facts(
            "Scene", rows, display.figure(plan, "cameras from above; hollow: held out"), f"<div>{photos}</div>"
        )


def evenly_spaced(views: list[View], most: int) -> list[View]:
    """Choose at most `most` of the views, evenly spaced from the first to the last."""
    return [views[i] for i in np.linspace(0, len(views) - 1, min(len(views), most)).round().astype(int)]
