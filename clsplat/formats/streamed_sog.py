"""The streamed SOG of PlayCanvas: a tree of SOG scenes in several levels of detail.

``lod-meta.json`` names the SOG scenes beside it (folders or .sog files), and has a tree whose nodes give, for each
level of detail, the scene, the first Gaussian and the number of Gaussians that show the node. Level 0 is the finest.
Another scene, the environment, may always be shown.
Source: the specification of version 1,
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog, and the writer and the reader of
splat-transform, https://github.com/playcanvas/splat-transform.
"""

import json
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import remove, replacing
from clsplat.config import Mode
from clsplat.errors import InputError
from clsplat.formats.detail_tree import Node, bounds
from clsplat.formats.quantisation import morton_order
from clsplat.formats.sog import META, load_sog, save_sog_folder
from clsplat.formats.validity import reading
from clsplat.gaussians import Gaussians

LOD_META = "lod-meta.json"
"""Name of the file that describes the scene."""

Span = tuple[int, int, int]
"""A file's index, the first row and the number of rows in it."""


def load_streamed_sog(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read the finest level of detail from a folder with a lod-meta.json, or from the lod-meta.json in it.

    Returns
    -------
    gaussians, mode, offset
        As in `clsplat.formats.load_gaussians`, with the environment if there is one. The offset is that of the first
        scene.

    Raises
    ------
    InputError
        If a file cannot be read or is not what the tree expects, the tree is damaged, or it holds no Gaussian.
    """
    folder, meta, spans = read_tree(path)
    units: dict[str, list[Span]] = {}
    try:
        for span in spans:
            units.setdefault(_inside(path, meta["filenames"][span[0]]), []).append(span)
        if "environment" in meta:
            units[_inside(path, meta["environment"])] = []
    except (AttributeError, LookupError, TypeError) as error:
        raise InputError(f"cannot read {path}: {LOD_META} names its files wrongly: {error!r}") from error
    parts, modes, offsets = [], [], []
    for name, own in units.items():
        gaussians, mode, offset = load_sog(folder / name)
        modes.append(mode)
        offsets.append(offset)
        taken = sum(count for _, _, count in own)
        if taken > len(gaussians) or any(first + count > len(gaussians) for _, first, count in own):
            raise InputError(
                f"{path}: expected {name} to hold the {taken} Gaussians that the tree names, found "
                f"{len(gaussians)}; the files are of different scenes or damaged"
            )
        if own:
            rows = np.concatenate([np.arange(first, first + count) for _, first, count in own])
            gaussians = gaussians.take(rows)
        parts.append(gaussians)
    return Gaussians.concatenate(parts), "antialiased" if "antialiased" in modes else "classic", offsets[0]


class _Part(NamedTuple):
    """A leaf in the file of a node: its number, its first Gaussian and their number, and the corners of their box."""

    leaf: int
    first: int
    size: int
    low: Any
    high: Any


class StreamedSogWriter:
    """A streamed SOG that is being written: a SOG scene for each node, and lod-meta.json as the last file.

    Each leaf of the tree can be shown in any level, whatever the others show. Rounding errors are those of
    `save_sog`, with ranges and codebooks of each node.

    Parameters
    ----------
    folder : Path
        Existing folder.
    mode, offset
        As in `clsplat.formats.save_gaussians`.
    """

    def __init__(self, folder: Path, mode: Mode = "classic", offset: ArrayLike | None = None):
        self._folder, self._mode, self._offset = folder, mode, offset
        self._written: dict[tuple[int, int], list[_Part]] = {}

    def add(self, node: Node) -> None:
        """Write a node; an older index goes. Threads may add nodes at the same time, in any order.

        Raises
        ------
        InputError
            If a value is not finite as float32, or a file cannot be written or removed.
        """
        remove(self._folder / LOD_META)  # it must not name files of two scenes if this process ends here
        ordered, parts, at = [], [], 0
        for leaf, count in node.leaves:
            part = node.gaussians.take(np.arange(at, at + count))
            ordered.append(part.take(morton_order(part.means)))
            parts.append(_Part(leaf, at, count, *bounds(part)))
            at += count
        folder = self._folder / _name(node.height, node.number)
        save_sog_folder(folder, Gaussians.concatenate(ordered), self._mode, self._offset)
        self._written[node.height, node.number] = parts

    def finish(self) -> None:
        """Write lod-meta.json.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        # Children come before their parent.
        places = sorted(self._written, key=lambda place: ((place[1] + 1) << place[0], place[0]))
        counts = [0] * (1 + max(height for height, _ in places))
        lods: dict[int, dict[str, dict[str, int]]] = {}
        corners: dict[int, list[tuple[Any, Any]]] = {}
        for file, (height, number) in enumerate(places):
            for part in self._written[height, number]:
                counts[height] += part.size
                lods.setdefault(part.leaf, {})[str(height)] = {
                    "file": file,
                    "offset": part.first,
                    "count": part.size,
                }
                corners.setdefault(part.leaf, []).append((part.low, part.high))
        meta = {
            "version": 1,
            "asset": {"generator": "clsplat"},
            "count": sum(counts),
            "counts": counts,
            "lodLevels": len(counts),
            "filenames": [f"{_name(*place)}/{META}" for place in places],
            "tree": _branch(sorted(lods), lods, {leaf: _around(boxes) for leaf, boxes in corners.items()}),
        }
        with replacing(self._folder / LOD_META) as out:
            out.write(json.dumps(meta).encode())


def _name(height: int, number: int) -> str:
    return f"{height}_{number}"


def _around(boxes: list[tuple[Any, Any]]) -> tuple[Any, Any]:
    """The corners around boxes, which are given by theirs."""
    return np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)


def _branch(leaves: list[int], lods: dict[int, Any], corners: dict[int, tuple[Any, Any]]) -> dict[str, Any]:
    """The tree over consecutive leaves, a power of two of them."""
    low, high = _around([corners[leaf] for leaf in leaves])
    node: dict[str, Any] = {"bound": {"min": low.tolist(), "max": high.tolist()}}
    if len(leaves) == 1:
        return node | {"lods": lods[leaves[0]]}
    half = len(leaves) // 2
    return node | {"children": [_branch(part, lods, corners) for part in (leaves[:half], leaves[half:])]}


def read_tree(path: str | Path) -> tuple[Path, dict[str, Any], list[Span]]:
    """Read lod-meta.json; return its folder, its content, and the spans of Gaussians of the finest level.

    Raises
    ------
    InputError
        If the file cannot be read, is damaged or of another version, or names no Gaussian.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    with reading(path):
        text = (folder / LOD_META).read_bytes()
    try:
        meta = json.loads(text)
        if meta.get("version", 1) != 1:
            raise InputError(f"{path}: expected {LOD_META} of version 1, found version {meta['version']!r}")
        spans = list(_finest(meta["tree"]))
    except (AttributeError, LookupError, TypeError, ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot read {path}: its {LOD_META} is damaged: {error!r}") from error
    if not spans:
        raise InputError(f"{path}: expected Gaussians in the tree of {LOD_META}, found none")
    return folder, meta, spans


def _finest(tree: dict[str, Any]) -> Iterator[Span]:
    """Yield the spans of the finest level of each node that has some, without empty ones."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        lods = node.get("lods") or {}
        if lods:
            lod = lods[min(lods, key=int)]
            span = (lod["file"], lod["offset"], lod["count"])
            if not all(type(value) is int and 0 <= value < 2**32 for value in span):
                raise ValueError(f"the span {lod}")
            if lod["count"]:
                yield span
        waiting += reversed(node.get("children") or [])


def _inside(path: str | Path, name: str) -> str:
    """Return the name of a file in the folder of lod-meta.json; raise an InputError if it lies elsewhere."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\\" in name or ":" in name:
        raise InputError(f"{path}: expected files beside {LOD_META}, found {name!r}")
    return name
