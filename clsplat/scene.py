"""A posed set of photos, as every reader of `clsplat.formats` returns it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clsplat import display
from clsplat.camera import Camera

Color = tuple[float, float, float]

THUMBNAILS = 8
"""Photos of a scene that a notebook shows."""


@dataclass(frozen=True, eq=False)
class View:
    """One photo and its camera.

    Parameters
    ----------
    name : str
        Path of the photo inside its folder, with forward slashes.
    camera : Camera
        Pinhole camera of the photo's size, in the scene's coordinates.
    image : (H, W, 3) uint8
        The photo: undistorted, upright, composited on the background where it was transparent.
    mask : (H, W) bool, optional
        True where pixels count.
    clear : (H, W) uint8, optional
        What shows of the background, of 255, where the photo is transparent and trains on random backgrounds.
    """

    name: str
    camera: Camera
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_] | None = None
    clear: NDArray[np.uint8] | None = None

    def on(self, background: Color, loaded_on: Color) -> NDArray[np.uint8]:
        """The photo (H, W, 3) on another background than the one it was loaded on, RGB in [0, 1]."""
        if self.clear is None:
            return self.image
        change = self.clear[:, :, None] * (np.array(background) - np.array(loaded_on))
        return np.rint(np.clip(self.image + change, 0, 255)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Scene:
    """Views and points in one coordinate system.

    Parameters
    ----------
    train, test : list of View
        The photos trained on and the photos held out, each sorted by name.
    points : (P, 3) float64
        Sparse points in the scene's coordinates; P may be 0.
    colors : (P, 3) uint8
        Their colours.
    offset : (3,) float64
        What was subtracted from the world's coordinates: not 0 only for geo-referenced scenes.
    """

    train: list[View]
    test: list[View]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    @property
    def extent(self) -> float:
        """Scale of the scene in world units: 1.1 times the largest distance of a training camera from their mean
        (the original's `cameras_extent`); 1 where all cameras stand at one place."""
        centres = np.array([view.camera.position for view in self.train])
        radius = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
        # Faces of a panorama stand at one place but for rounding.
        return 1.1 * radius if radius > 1e-12 * np.abs(centres).max() else 1.0

    def _repr_html_(self) -> str:
        views = [*self.train, *self.test]
        rows = {
            "photos": f"{len(self.train)} to train on, {len(self.test)} held out",
            "sizes": ", ".join(sorted({f"{v.camera.width} x {v.camera.height}" for v in views})),
            "masks": str(sum(v.mask is not None for v in views)),
            "points": f"{len(self.points):,}",
        }
        if self.offset.any():
            rows["offset"] = display.numbers(self.offset)
        if not views:
            return display.facts("Scene", rows)
        rows["extent"] = f"{self.extent:.3g}" if self.train else ""
        eyes = np.array([v.camera.position for v in views])
        looks = np.array([v.camera.viewmat[2, :3] for v in views])
        up = -np.mean([v.camera.viewmat[1, :3] for v in views], axis=0)
        # Of the axes at right angles to up any will do; that of the first camera's right edge is the familiar one.
        east = views[0].camera.viewmat[0, :3] - up * (views[0].camera.viewmat[0, :3] @ up) / max(up @ up, 1e-12)
        ground = np.stack([east, np.cross(up, east)])
        ground /= np.maximum(np.linalg.norm(ground, axis=1, keepdims=True), 1e-12)
        held_out = np.arange(len(views)) >= len(self.train)
        plan = display.plan(eyes @ ground.T, looks @ ground.T, held_out, self.points @ ground.T, self.colors)
        chosen = self.train[:: -(-len(self.train) // THUMBNAILS) or 1] or self.test[:THUMBNAILS]
        photos = "".join(display.thumbnail(view.image, view.name) for view in chosen)
        return display.facts(
            "Scene", rows, display.figure(plan, "cameras from above; hollow: held out"), f"<div>{photos}</div>"
        )
