"""Jobs: files that say how a block is trained, named by the digest of everything that its result depends on."""

import json
from dataclasses import asdict, dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.atomic import replacing
from clsplat.blocks.partition import EVERYWHERE, Block, Box
from clsplat.camera import Camera
from clsplat.config import TrainConfig
from clsplat.dataset.brightness import even
from clsplat.errors import InputError, named
from clsplat.inputs import Photo
from clsplat.scene import DIGEST_BYTES, DepthMap, Scene, View, digest
from clsplat.training.checkpoint import without_free
from clsplat.training.presets import with_settings

BOXES = ("near", "box", "wide")
"""Boxes of a job."""

NAMES = ("data", "scene", "far", "sky", "points", "moving")
"""Folders and files of a job."""

FIT = ("inverse", "scale", "shift")
"""Fields of a depth map that its fit to the scene's points determines."""

FORMAT = 4
"""Version of the files of jobs."""


@dataclass(frozen=True)
class Job:
    """Description of the training of a block.

    data: folder of the dataset; scene: name of the index (`clsplat.blocks.parts`), beside the job's file, of the
    Gaussians from which the block starts and that surround it; near: where these are used; far: the index of those
    elsewhere; sky: the index of those of the sky, which no block trains, or empty; points: the index of Gaussians at
    sparse points, which the block trains, too, or empty; moving: the file of the masks of what moves
    (`clsplat.blocks.masks`), or empty; box, wide: what the block keeps and trains; photos: digests of pixels and
    mask, by name; cameras: as the scene has them, by name; depths: for photos with a depth map, by name, the digest
    of its values and its fit to the points; gains: factors by which the colours of photos are divided, by name;
    config: settings of the block.
    """

    data: str
    scene: str
    near: Box
    far: str
    sky: str
    points: str
    moving: str
    box: Box
    wide: Box
    photos: dict[str, Photo]
    cameras: dict[str, dict[str, Any]]
    depths: dict[str, dict[str, Any]]
    gains: dict[str, list[float]]
    config: TrainConfig

    @property
    def digest(self) -> str:
        """Digest of what the result depends on: all but the dataset's place and settings that change no bit."""
        content = self.content() | {"config": asdict(without_free(self.config))}
        del content["data"]
        return digest_of(json.dumps(content, sort_keys=True).encode())

    def content(self) -> dict[str, Any]:
        """The job as JSON."""
        return {
            "format": FORMAT,
            "data": self.data,
            "scene": self.scene,
            "far": self.far,
            "sky": self.sky,
            "points": self.points,
            "moving": self.moving,
            **{name: [_face(side) for side in getattr(self, name)] for name in BOXES},
            "photos": {
                name: {"pixels": photo.pixels, "mask": photo.mask, "camera": self.cameras[name]}
                for name, photo in self.photos.items()
            },
            "config": asdict(self.config),
            **({"depths": self.depths} if self.depths else {}),
            **({"gains": self.gains} if self.gains else {}),
        }

    def write(self, folder: Path) -> Path:
        """Write the job into a folder; return its file, which has the name of its digest."""
        path = folder / f"{self.digest}.json"
        with replacing(path) as file:
            file.write((json.dumps(self.content(), indent=1) + "\n").encode())
        return path

    def posed(self) -> list[Camera]:
        """The cameras of the photos, in their order."""
        return [_camera(self.cameras[name]) for name in self.photos]

    def views(self, loaded: list[View]) -> list[View]:
        """The photos of the block with its cameras, of those that have been loaded.

        Raises
        ------
        InputError
            If one is missing, or has other pixels, another mask or other depths than the job was made for.
        """
        by_name = {view.name: view for view in loaded}
        missing = [name for name in self.photos if name not in by_name]
        if missing:
            raise InputError(f"{self.data}: expected the photos of a block, missing {named(missing)}")
        chosen = [by_name[name] for name in self.photos]
        expected = {name: (photo.pixels, photo.mask) for name, photo in self.photos.items()}
        for view in chosen:  # those that stream are compared when they are read
            view.expect(expected[view.name])
        other = [view.name for view in chosen if view.digests != expected[view.name]]
        if other:
            raise InputError(
                f"{self.data}: expected the photos that the block was planned with, found other pixels or masks "
                f"({named(other)}); start a new run in another folder"
            )
        posed = [view.with_camera(_camera(self.cameras[view.name])) for view in chosen]
        return even([view.with_depth(self._depth(view)) for view in posed], self.gains)

    def _depth(self, view: View) -> DepthMap | None:
        """The depth map of a photo as the whole scene is trained with it."""
        if view.name not in self.depths:
            return None
        values, fit = self.depths[view.name]["values"], self.depths[view.name]["fit"]
        if view.depth is None or digest(view.depth.values) != values:
            raise InputError(
                f"{self.data}: expected the depth map that the block was planned with, found another one "
                f"({view.name}); start a new run in another folder"
            )
        return replace(view.depth, **fit)


def make_job(
    data: Path, names: dict[str, str], block: Block, scene: Scene, photos: dict[str, Photo], config: TrainConfig
) -> Job:
    """Make the job of a block in the coarse scene, without sparse points.

    names: files of the coarse run, "far", "sky" and "moving"; scene: with the photos of the block; photos: digests of
    all photos; config: settings of the block.
    """
    views = [scene.train[i] for i in block.photos]
    cameras = {view.name: asdict(view.camera) | {"viewmat": view.camera.viewmat.tolist()} for view in views}
    own = {view.name: photos[view.name] for view in views}
    depths = {
        view.name: {"values": digest(depth.values), "fit": {name: getattr(depth, name) for name in FIT}}
        for view in views
        if (depth := view.depth)
    }
    gains = {name: scene.gains[name].tolist() for name in own if name in scene.gains}
    files: dict[str, Any] = {"data": str(data), "scene": names["far"], **names, "points": ""}
    boxes: dict[str, Any] = {"near": EVERYWHERE, "box": block.box, "wide": block.wide}
    return Job(**files, **boxes, photos=own, cameras=cameras, depths=depths, gains=gains, config=config)


def read_job(path: Path) -> Job:
    """Read a job.

    Raises
    ------
    InputError
        If the file cannot be read, is damaged, or is not named by its digest: it has been changed.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise InputError(f"{path}: expected a job of format {FORMAT}, found {content['format']!r}")
        boxes: dict[str, Any] = {n: Box(_corner(content[n][0], -1), _corner(content[n][1], 1)) for n in BOXES}
        files: dict[str, Any] = {name: str(content[name]) for name in NAMES}
        photos = {name: Photo(str(p["pixels"]), str(p["mask"]), []) for name, p in content["photos"].items()}
        cameras = {name: dict(p["camera"]) for name, p in content["photos"].items()}
        depths = {str(name): dict(depth) for name, depth in content.get("depths", {}).items()}
        gains = {str(name): [float(x) for x in factor] for name, factor in content.get("gains", {}).items()}
        config = with_settings(TrainConfig(), content["config"], str(path))
        job = Job(**files, **boxes, photos=photos, cameras=cameras, depths=depths, gains=gains, config=config)
        found = job.digest
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except (AttributeError, IndexError, KeyError, RecursionError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: expected a job that `clsplat train --blocks` wrote, found {error!r}") from error
    if path.stem != found:
        raise InputError(f"{path}: expected a job as it was written, found a changed one; plan the run again")
    return job


def digest_of(*parts: bytes) -> str:
    """Digest of bytes, as text."""
    result = blake2b(digest_size=DIGEST_BYTES)
    for part in parts:
        result.update(part)
    return result.hexdigest()


def _face(side: tuple[float, ...]) -> list[float | None]:
    return [x if np.isfinite(x) else None for x in side]


def _corner(side: list[float | None], sign: int) -> tuple[float, ...]:
    return tuple(sign * np.inf if x is None else float(x) for x in side)


def _camera(saved: dict[str, Any]) -> Camera:
    return Camera(**saved | {"viewmat": np.array(saved["viewmat"]), "distortion": tuple(saved["distortion"])})
