"""The commands `frames`, `sfm` and `export`."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from clsplat.commands import console
from clsplat.commands.console import (
    OptionalOut,
    Out,
    SceneOrRun,
    moved,
    picture_cameras,
    say,
    say_cameras,
)
from clsplat.commands.options import PageOptions, PlaceOptions
from clsplat.commands.run_folders import as_trained, is_run, read_run, scene_file, with_run
from clsplat.config import Mode, SfmConfig, TrainConfig
from clsplat.errors import InputError, new_folder
from clsplat.formats.spz_container import Axes, Version
from clsplat.ranges import within

if TYPE_CHECKING:
    from clsplat.formats.detail_tree import Node
    from clsplat.gaussians import Gaussians
    from clsplat.scene import Scene


@dataclass(frozen=True)
class Frames:
    """Extract photos from a video: the sharpest frame of each interval."""

    video: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="VIDEO")]
    """The video; needs the extra `video`."""
    out: Out
    """New folder for the photos."""
    fps: Annotated[float, within(above=0)] = 2.0
    """Photos per second of the video."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset.video import extract_frames

        count = extract_frames(self.video, self.out, self.fps)
        say(f"{self.out}: {count} frames of {self.video.name}; next: clsplat train {self.out} -o SCENE")


@dataclass(frozen=True)
class Sfm:
    """Recover the cameras of a folder of photos; `train` does this itself."""

    photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photos."""
    out: OptionalOut = None
    """Folder for the model; default: the folder of the photos."""
    sfm: Annotated[SfmConfig, tyro.conf.arg(name="")] = field(default_factory=SfmConfig)

    def run(self) -> None:
        """Run the command."""
        from clsplat.dataset.sfm.reconstruction import reconstruct

        model = reconstruct(self.photos, self.sfm, self.out, verbose=console.loudness == "verbose")
        say_cameras(self.out or self.photos)
        picture_cameras(self.out or self.photos, model.parent / "cameras.png")
        print(model)


@dataclass(frozen=True)
class Export:
    """Convert a scene to another format, to levels of detail, or to a web page that shows it in any browser."""

    scene: SceneOrRun
    """File of Gaussians, or the folder of a run."""
    to: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[FILE|FOLDER]")] = None
    """File to write; its suffix determines the format; .html makes a web page. FOLDER/lod-meta.json writes a streamed
    SOG and FOLDER/tileset.json 3D Tiles, in levels of detail; a name without a suffix is the folder of both."""
    out: OptionalOut = None
    """Alternative to the second argument."""
    spz_version: Version = 3
    """Version of an .spz that is written: 3, which all programs read, or 4, which is compressed by Zstandard."""
    spz_axes: Axes | None = None
    """Axes of the .spz that is written, or of the one that is read if none is written: right, up, back as specified,
    or right, down, forward as in a PLY, which splat-transform writes. Default: as specified, or as the file says."""
    place: Annotated[PlaceOptions, tyro.conf.arg(name="")] = field(default_factory=PlaceOptions)
    data: Annotated[Path | None, tyro.conf.arg(metavar="DATASET")] = None
    """For a web page: dataset, as for `train`. Its first photo is the first view, and its cameras determine the
    upward direction. Default: the dataset of the run."""
    data_config: Annotated[PageOptions, tyro.conf.arg(name="")] = field(default_factory=PageOptions)

    def base(self) -> "Export | None":
        """The command with the settings of its run, before flags override them; None if it has none."""
        return with_run(self)

    def run(self) -> None:
        """Run the command."""
        from clsplat.formats import save_gaussians, suffix_of
        from clsplat.formats.spz import save_spz

        if (self.to is None) == (self.out is None):
            raise InputError("export: expected one file to write, as in: clsplat export scene.ply scene.spz")
        out = self.to or self.out
        assert out is not None
        levels = out.name in ("lod-meta.json", "tileset.json") or not out.suffix
        scene = scene_file(self.scene)
        to_spz, from_spz = (suffix_of(path) == ".spz" for path in (out, scene))
        if self.spz_axes is not None and not (to_spz or from_spz):
            raise InputError(f"--spz-axes: expected an .spz to read or to write, found {scene} and {out}")
        if self.spz_version != 3 and not to_spz:
            raise InputError(f"--spz-version: expected an .spz to write, found {out}")
        if levels:
            if self.place != PlaceOptions():
                raise InputError(
                    "--scale, --rotate, --move: expected a file to write, found levels of detail; export a .ply first"
                )
            self._levels(scene, out)
            return
        gaussians, mode, offset = self._placed(*self._load(scene, from_spz and not to_spz))
        if out.suffix.lower() == ".html":
            self._page(out, gaussians, mode, offset)
        elif to_spz:
            axes = self.spz_axes or "rub"
            save_spz(out, gaussians, mode, offset, version=self.spz_version, axes=axes)
        else:
            save_gaussians(out, gaussians, mode, offset)
        say(f"{out}: {len(gaussians)} Gaussians, {out.stat().st_size / 1e6:.3g} MB")

    def _load(self, scene: Path, turn: bool) -> "tuple[Gaussians, Mode, Any]":
        """Read the scene; if `turn` is set, an .spz with the axes of --spz-axes."""
        from clsplat.formats import load_gaussians
        from clsplat.formats.spz import load_spz

        return load_spz(scene, self.spz_axes) if turn else load_gaussians(scene)

    def _placed(self, gaussians: "Gaussians", mode: Mode, offset: Any) -> "tuple[Gaussians, Mode, Any]":
        """The scene in its new place."""
        from scipy.spatial.transform import Rotation

        from clsplat.formats.axes import placed

        if self.place == PlaceOptions():
            return gaussians, mode, offset
        turn = Rotation.from_euler("xyz", self.place.rotate, degrees=True).as_matrix()
        move = np.array(self.place.move)
        gaussians, offset = placed(gaussians, np.asarray(offset, float), self.place.scale, turn, move)
        return gaussians, mode, offset

    def _levels(self, file: Path, out: Path) -> None:
        """Write levels of detail; those of a run with its dataset are refined against its photos. A PLY without
        photos is read in parts, and need not fit the memory."""
        from clsplat.formats import suffix_of
        from clsplat.formats.ply_parts import PlyParts
        from clsplat.pruning.levels import detail_tree, detail_tree_of_file
        from clsplat.training.level_refinement import refined
        from clsplat.training.preparation import open_device

        folder = out.parent if out.suffix else out
        scene, config = self._photos()
        nodes: Iterable[Node]
        rows = PlyParts(file) if scene is None and suffix_of(file) == ".ply" else None
        if rows is not None and rows.binary:
            mode, offset = rows.mode, rows.offset
            nodes = detail_tree_of_file(rows, folder)
        else:
            gaussians, mode, offset = self._load(file, suffix_of(file) == ".spz")
            if scene is not None:
                gaussians, offset = moved(gaussians, offset - scene.offset), scene.offset
            nodes = detail_tree(gaussians)
        new_folder(folder)
        if scene is not None:
            nodes = refined(nodes, scene, config, open_device(config), say)
        self._write_levels(out, nodes, mode, offset)

    def _write_levels(self, out: Path, nodes: "Iterable[Node]", mode: Mode, offset: Any) -> None:
        from clsplat.formats.streamed_sog import LOD_META, StreamedSogWriter
        from clsplat.formats.tiles_3d import TILESET, TilesWriter
        from clsplat.pruning.leaf_threads import in_threads

        folder = out.parent if out.suffix else out
        writers: list[StreamedSogWriter | TilesWriter] = []
        if out.name != TILESET:
            writers.append(StreamedSogWriter(folder, mode, offset))
        if out.name != LOD_META:
            writers.append(TilesWriter(folder, mode, offset))
        counts: Counter[int] = Counter()

        def write(node: "Node") -> tuple[int, int]:
            for writer in writers:
                writer.add(node)
            return node.height, len(node.gaussians)

        for height, count in in_threads(write, nodes):
            counts[height] += count
        for writer in writers:
            writer.finish()
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        of_levels = ", ".join(str(counts[height]) for height in sorted(counts))
        say(f"{folder}: {len(counts)} levels of {of_levels} Gaussians, {size / 1e6:.3g} MB")

    def _photos(self) -> "tuple[Scene | None, TrainConfig]":
        """The dataset of the run that is exported, its photos `as_trained`, and the run's settings; None in place of
        the dataset without held-out photos."""
        from clsplat.dataset import load_scene, with_points
        from clsplat.training.preparation import photo_memory

        if not is_run(self.scene) or self.data is None:
            return None, TrainConfig()
        config = read_run(self.scene).config
        scene = load_scene(self.data, config.data, memory=photo_memory(config))
        if not scene.test:
            say("levels: not refined, as no held-out photo can show whether that pays")
            return None, config
        scene = with_points(scene, self.data, config.data) if config.init.triangulate else scene
        return as_trained(scene, self.scene, config), config

    def _page(self, out: Path, gaussians: "Gaussians", mode: Mode, offset: Any) -> None:
        from clsplat.dataset import load_scene
        from clsplat.show.camera_paths import first_photo, overview
        from clsplat.show.web_page import save_page

        views = []
        if self.data is not None and self.place == PlaceOptions():  # its cameras are in the scene's first place
            scene = load_scene(self.data, self.data_config)
            gaussians, views = moved(gaussians, offset - scene.offset), scene.train + scene.test
        start = first_photo([view.camera for view in views]) if views else overview(gaussians)
        save_page(out, gaussians, mode, start, self.data_config.background)
