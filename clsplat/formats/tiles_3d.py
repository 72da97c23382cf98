"""3D Tiles 1.1 whose contents are .glb with KHR_gaussian_splatting: levels of detail for CesiumJS and other globes.
The Gaussians of a tile are compressed as .spz, since CesiumJS draws no others.

``tileset.json`` has a tree of tiles. A tile is replaced by its children where its geometric error, projected to the
screen, is too large. Tiles have the axes right, forward, up; the content's axes of glTF are turned to them by the
viewer.
Source: the specification, https://github.com/CesiumGS/3d-tiles/tree/main/specification.
"""

import json
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import remove, replacing
from clsplat.config import Mode
from clsplat.errors import InputError
from clsplat.formats.detail_tree import Node, bounds
from clsplat.formats.gltf import EXTENSION, SPZ_EXTENSION, load_glb
from clsplat.formats.gltf_spz import save_spz_glb
from clsplat.formats.validity import reading
from clsplat.gaussians import Gaussians

TILESET = "tileset.json"
"""Name of the file that describes the scene."""

Z_UP = np.array([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])
"""From the axes right, down, forward of a PLY to those of tiles. glTF has (-x, -y, z), and a viewer turns its y to z
up: (x, -z, y) of that."""

COVERED = 0.9
"""Quantile of the largest scales in a tile that counts as its geometric error: what is smaller is not in the tile."""


class TilesWriter:
    """3D Tiles that are being written: a .glb for each node, and tileset.json as the last file.

    Parameters
    ----------
    folder : Path
        Existing folder.
    mode, offset
        As in `clsplat.formats.save_gaussians`; stored in each .glb.
    """

    def __init__(self, folder: Path, mode: Mode = "classic", offset: ArrayLike | None = None):
        self._folder, self._mode, self._offset = folder, mode, offset
        self._written: dict[tuple[int, int], tuple[Any, Any, float]] = {}  # corners and geometric error

    def add(self, node: Node) -> None:
        """Write a node; an older index goes. Threads may add nodes at the same time, in any order.

        Raises
        ------
        InputError
            If a value is not finite as float32, or a file cannot be written or removed.
        """
        remove(self._folder / TILESET)  # it must not name files of two scenes if this process ends here
        save_spz_glb(self._folder / _name(node.height, node.number), node.gaussians, self._mode, self._offset)
        largest = np.exp(node.gaussians.log_scales.max(axis=1).astype(np.float64))
        error = float(np.quantile(largest, COVERED)) if node.height else 0.0
        self._written[node.height, node.number] = (*bounds(node.gaussians), error)

    def _tile(self, height: int, number: int) -> dict[str, Any]:
        """A tile and those below it, with the corners of its box."""
        low, high, error = self._written[height, number]
        children = [self._tile(height - 1, 2 * number + k) for k in range(2 if height else 0)]
        for child in children:  # a tile contains its children
            low, high = np.minimum(low, child["corners"][0]), np.maximum(high, child["corners"][1])
        return {
            "corners": (low, high),
            "boundingVolume": {"box": _box(low, high)},
            "geometricError": max([error, *(child["geometricError"] for child in children)]),
            "refine": "REPLACE",
            "content": {"uri": _name(height, number)},
            **({"children": [_without_corners(child) for child in children]} if children else {}),
        }

    def finish(self) -> None:
        """Write tileset.json.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        root = self._tile(*max(self._written))
        names = [EXTENSION, SPZ_EXTENSION]  # CesiumJS takes a tile for a mesh unless both are required here
        uses = {"extensionsUsed": names, "extensionsRequired": names}
        content = {
            "asset": {"version": "1.1", "generator": "clsplat"},
            "extensionsUsed": ["3DTILES_content_gltf"],
            "extensions": {"3DTILES_content_gltf": uses},
            # The error of drawing nothing: the size of the scene, which disappears where that is too small to matter.
            "geometricError": max(root["geometricError"], float(np.linalg.norm(np.subtract(*root["corners"])))),
            "root": _without_corners(root),
        }
        with replacing(self._folder / TILESET) as file:
            file.write(json.dumps(content).encode())


def _name(height: int, number: int) -> str:
    return f"{height}_{number}.glb"


def _without_corners(tile: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in tile.items() if name != "corners"}


def _box(low: NDArray[np.float64], high: NDArray[np.float64]) -> list[float]:
    """The twelve numbers of a box: its centre and three half axes."""
    centre, half = Z_UP @ ((low + high) / 2), np.abs(Z_UP @ ((high - low) / 2))
    return [*centre.tolist(), *np.diag(half).ravel().tolist()]


def load_tiles(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read the finest tiles from a folder with a tileset.json, or from the tileset.json in it.

    Returns
    -------
    gaussians, mode, offset
        As in `clsplat.formats.load_gaussians`; mode and offset are those of the first tile.

    Raises
    ------
    InputError
        If a file cannot be read, the tileset is damaged, places its tiles by transforms, or has no tile of Gaussians.
    """
    folder, names = read_tileset(path)
    parts = [load_glb(folder / name) for name in names]
    return Gaussians.concatenate([part[0] for part in parts]), parts[0][1], parts[0][2]


def read_tileset(path: str | Path) -> tuple[Path, list[str]]:
    """Read tileset.json; return its folder, and the names of the contents that the finest view shows.

    Raises
    ------
    InputError
        If the file cannot be read, is damaged, places its tiles by transforms, or names no content beside it.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    with reading(path):
        text = (folder / TILESET).read_bytes()
    try:
        names = list(_finest(path, json.loads(text)["root"]))
    except (AttributeError, LookupError, TypeError, ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot read {path}: its {TILESET} is damaged: {error!r}") from error
    if not names:
        raise InputError(f"{path}: expected tiles with contents in {TILESET}, found none")
    return folder, names


def _finest(path: Path, root: dict[str, Any]) -> Iterator[str]:
    """Names of the contents that the finest view shows: those of tiles without children, and of tiles whose children
    are drawn in addition to them."""
    waiting = [(root, "REPLACE")]
    while waiting:
        tile, inherited = waiting.pop()
        if "transform" in tile:
            raise InputError(f"{path}: expected tiles in one coordinate system, found a tile with a transform")
        refine, children = str(tile.get("refine", inherited)).upper(), tile.get("children") or []
        waiting += [(child, refine) for child in reversed(children)]
        if children and refine == "REPLACE":
            continue
        for content in [tile["content"]] if "content" in tile else tile.get("contents", []):
            name = unquote(content["uri"])
            parts = PurePosixPath(name).parts
            if not parts or name.startswith("/") or ".." in parts or "\\" in name or ":" in name:
                raise InputError(f"{path}: expected contents beside {TILESET}, found {name!r}")
            yield name
