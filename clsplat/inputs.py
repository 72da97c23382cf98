"""The inputs of a run: photos, cameras, points and device, by which a checkpoint recognises them."""

import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import CameraModel
from clsplat.errors import InputError, named
from clsplat.scene import Scene, View, digest

if TYPE_CHECKING:
    from clsplat.device import Device

CAMERA_TOLERANCE = 1e-9
"""Relative difference up to which a camera counts as the same: of each intrinsic number, of each row of the rotation,
of the translation. Poses come from linear algebra in float64, whose rounding depends on the processor; a run may move
to another machine."""

POSE = 15
"""Length of a pose in the numbers of a camera: three rows of a rotation, a translation, the scene's offset."""


class Photo(NamedTuple):
    """A photo of a run: digests of its pixels, of its mask and of its depth map (empty without one), and the numbers
    of its camera.

    The digest of the pixels is empty as long as the photo, which streams from the disk, has not been read.
    """

    pixels: str
    mask: str
    camera: list[float]
    depth: str = ""


@dataclass(frozen=True)
class Inputs:
    """Inputs of a run.

    train, test: photos by name; points: digest of points and colours, empty without points; device: its platform,
    name and driver version; gains: those of the scene, with which the run continues.
    """

    train: dict[str, Photo] = field(default_factory=dict)
    test: dict[str, Photo] = field(default_factory=dict)
    points: str = ""
    device: str = ""
    gains: dict[str, list[float]] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, device: "Device") -> "Inputs":
        """The inputs of a training of a scene on a device."""
        train, test = (photos_of(part, scene.offset) for part in (scene.train, scene.test))
        points = digest(scene.points, scene.colors) if len(scene.points) else ""
        gains = {name: factors.tolist() for name, factors in scene.gains.items()}
        return cls(train, test, points, f"{device.label}, driver {device.cl_device.driver_version.strip()}", gains)

    @classmethod
    def restored(cls, saved: dict[str, Any]) -> "Inputs":
        """Inputs from their fields, as JSON gives them; any other value raises TypeError, ValueError or KeyError."""
        train, test = (
            {
                name: Photo(str(pixels), str(mask), [float(x) for x in camera], *map(str, depth))
                for name, (pixels, mask, camera, *depth) in saved.pop(part).items()
            }
            for part in ("train", "test")
        )
        gains = {name: [float(x) for x in factors] for name, factors in saved.pop("gains").items()}
        return cls(train, test, **{name: str(value) for name, value in saved.items()}, gains=gains)

    def continued(self, now: "Inputs", path: Path) -> "Inputs":
        """Inputs of a run that continues from these.

        Parameters
        ----------
        now : Inputs
            Those that are there now.
        path : Path
            The checkpoint, for the message.

        Raises
        ------
        InputError
            If anything but the device differs; the message says what.

        Warns
        -----
        UserWarning
            If the device differs.
        """
        if found := self._differences(now):
            raise InputError(
                f"{path}: expected the dataset it was made with, found {', and '.join(found)}; name that dataset, or "
                "start a new run in another folder"
            )
        if now.device != self.device:
            warnings.warn(
                f"the checkpoint was made on {self.device}; the run continues on {now.device}: its bits will differ "
                "from those of an uninterrupted run",
                stacklevel=2,
            )
        train, test = (
            {n: photo if photo.pixels or n not in old else old[n] for n, photo in part.items()}
            for part, old in ((now.train, self.train), (now.test, self.test))
        )
        return replace(now, train=train, test=test, gains=self.gains)

    def demand(self, scene: Scene) -> None:
        """Demand that the photos of a scene that have not been read have these digests, where they are known."""
        for views, photos in ((scene.train, self.train), (scene.test, self.test)):
            for view in views:
                if (photo := photos.get(view.name)) and photo.pixels:
                    view.expect((photo.pixels, photo.mask))

    def completed(self, scene: Scene) -> "Inputs":
        """The inputs with the digests of the photos that have been read since they were made."""
        parts = ((scene.train, self.train), (scene.test, self.test))
        if all(photo.pixels for _, photos in parts for photo in photos.values()):
            return self
        train, test = (
            photos | {v.name: photos[v.name]._replace(pixels=d[0], mask=d[1]) for v in views if (d := v.digests)}
            for views, photos in parts
        )
        return replace(self, train=train, test=test)

    def _differences(self, now: "Inputs") -> list[str]:
        old, new = self.train | self.test, now.train | now.test
        both = sorted(old.keys() & new.keys())
        read = [name for name in both if old[name].pixels and new[name].pixels]
        differing = {
            "fewer photos": sorted(old.keys() - new.keys()),
            "more photos": sorted(new.keys() - old.keys()),
            "another choice of held-out photos": [name for name in both if (name in self.test) != (name in now.test)],
            "other pixels": [name for name in read if old[name].pixels != new[name].pixels],
            "other masks": [name for name in read if old[name].mask != new[name].mask],
            "other depth maps": [name for name in both if old[name].depth != new[name].depth],
        }
        if self.train.keys() == now.train.keys():  # near planes follow the set of training photos
            differing["other cameras"] = [n for n in both if not _same_camera(old[n].camera, new[n].camera)]
        found = [f"{what} ({named(names)})" for what, names in differing.items() if names]
        return found + ["other points"] * (now.points != self.points)


def photos_of(views: list[View], offset: NDArray[np.float64]) -> dict[str, Photo]:
    """Views by name, as a run recognises them; `offset` (3,) is that of their scene, world units."""
    return {view.name: _photo(view, offset) for view in views}


def _photo(view: View, offset: NDArray[np.float64]) -> Photo:
    c = view.camera
    numbers = [
        get_args(CameraModel).index(c.model),
        c.fx,
        c.fy,
        c.cx,
        c.cy,
        c.width,
        c.height,
        *c.distortion,
        c.near_depth,
    ]
    pose = (*c.viewmat[:3, :3].flat, *c.viewmat[:3, 3], *offset)
    depth = "" if view.depth is None else digest(view.depth.values)
    return Photo(*(view.digests or ("", "")), [float(x) for x in (*numbers, *pose)], depth)


def _same_camera(a: list[float], b: list[float]) -> bool:
    if len(a) != len(b):
        return False
    (intrinsics_a, pose_a), (intrinsics_b, pose_b) = ((v[:-POSE], np.reshape(v[-POSE:], (-1, 3))) for v in (a, b))
    return np.allclose(intrinsics_a, intrinsics_b, rtol=CAMERA_TOLERANCE, atol=0) and all(
        np.abs(x - y).max() <= CAMERA_TOLERANCE * np.linalg.norm(x) for x, y in zip(pose_a, pose_b, strict=True)
    )
