"""The container of .glb, binary glTF 2.0: chunks, arrays of numbers, and where the scene places its meshes.

Gaussians in it are `clsplat.formats.gltf`.
Source: the specification, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError

Array = NDArray[Any]

HEADER = struct.Struct("<4sII")
"""Layout of the header: magic, version, bytes of the file."""

CHUNK = struct.Struct("<I4s")
"""Layout of a chunk's header: its bytes, and its kind."""

SIZE_MAX = 2**32 - 1
"""Largest file, bytes: the header counts them in 32 bits."""

DTYPES = {
    code: np.dtype(name)
    for code, name in {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}.items()
}
"""Types of numbers by their code in OpenGL."""

WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
"""Numbers per row, by the type of an accessor."""

ARRAY_BUFFER = 34962
"""Code in OpenGL of buffers with a row per vertex."""


def read_chunks(path: str | Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    """Split a .glb into its JSON and its numbers.

    Raises
    ------
    InputError
        If the file is not a .glb of version 2, or is truncated.
    """
    if data[:4] != b"glTF" or len(data) < HEADER.size:
        raise InputError(f"{path}: expected a .glb file, which begins with glTF, found {data[:12]!r}")
    _, version, length = HEADER.unpack_from(data)
    if version != 2:
        raise InputError(f"{path}: expected glTF of version 2, found version {version}")
    if length != len(data):
        raise InputError(
            f"{path}: expected {length} bytes as the header declares, found {len(data)}; is it truncated?"
        )
    chunks: dict[bytes, bytes] = {}
    at = HEADER.size
    while at < len(data):
        if at + CHUNK.size > len(data):
            raise InputError(f"{path}: expected chunks to the end, found {len(data) - at} bytes; the file is damaged")
        count, kind = CHUNK.unpack_from(data, at)
        at += CHUNK.size + count
        if at > len(data):
            raise InputError(f"{path}: expected a chunk of {count} bytes, found fewer; the file is damaged")
        chunks.setdefault(kind, data[at - count : at])
    if b"JSON" not in chunks:
        raise InputError(f"{path}: expected a chunk of JSON, found {', '.join(map(repr, chunks)) or 'none'}")
    return json.loads(chunks[b"JSON"]), chunks.get(b"BIN\0", b"")


class GlbDocument:
    """A .glb that is being read.

    Its methods raise an InputError for what the format allows and clsplat does not read, and other exceptions for
    missing or contradictory JSON.
    """

    def __init__(self, path: str | Path, data: bytes) -> None:
        self.path, self.size = path, len(data)
        self.json, self.binary = read_chunks(path, data)

    def meshes(self) -> Iterator[tuple[int, Array]]:
        """Yield the meshes of the scene with their matrices; all meshes, unplaced, if there is no scene."""
        if not self.json.get("scenes"):
            yield from ((mesh, np.eye(4)) for mesh in range(len(self.json.get("meshes", []))))
            return
        nodes, seen = self.json["nodes"], set()
        waiting = [(node, np.eye(4)) for node in self.json["scenes"][self.json.get("scene", 0)].get("nodes", [])]
        while waiting:
            index, parent = waiting.pop()
            if index in seen:
                raise InputError(f"{self.path}: expected nodes with one parent each, found node {index} twice")
            seen.add(index)
            matrix = parent @ _local_matrix(nodes[index])
            if "mesh" in nodes[index]:
                yield nodes[index]["mesh"], matrix
            waiting += [(child, matrix) for child in reversed(nodes[index].get("children", []))]

    def view(self, index: int) -> bytes:
        """The bytes of a buffer view, which must be in the file itself."""
        view = self.json["bufferViews"][index]
        if view["buffer"] != 0 or "uri" in self.json["buffers"][0]:
            raise InputError(f"{self.path}: expected all data in the file itself, found some in another one")
        first, count = view.get("byteOffset", 0), view["byteLength"]
        if not (first >= 0 and 0 <= count <= len(self.binary) - first):
            raise InputError(f"{self.path}: expected {count} bytes of data, found {len(self.binary) - first}")
        return self.binary[first : first + count]

    def rows(self, name: str, index: int, expected: int) -> Array:
        """Read the rows of an attribute, (N, expected) float32; normalised integers become fractions."""
        accessor = self.json["accessors"][index]
        if "bufferView" not in accessor or "sparse" in accessor:
            raise InputError(f"{self.path}: expected {name} stored in full, found it sparse or compressed")
        view = self.json["bufferViews"][accessor["bufferView"]]
        if view["buffer"] != 0 or "uri" in self.json["buffers"][0]:
            raise InputError(f"{self.path}: expected {name} in the file itself, found it in another one")
        dtype, width = DTYPES[accessor["componentType"]], WIDTHS[accessor["type"]]
        if width != expected:
            raise InputError(f"{self.path}: expected {expected} numbers per row of {name}, found {width}")
        count, row = accessor["count"], dtype.itemsize * width
        stride = view.get("byteStride", row)
        start, end = accessor.get("byteOffset", 0), view["byteLength"]
        first = view.get("byteOffset", 0)
        if not (start >= 0 and first >= 0 and stride >= row and start + stride * (count - 1) + row <= end):
            raise InputError(f"{self.path}: expected {count} rows of {name}, found {end} bytes for them")
        if first + end > len(self.binary):
            raise InputError(f"{self.path}: expected {first + end} bytes of numbers, found {len(self.binary)}")
        array: Array = np.ndarray((count, width), dtype, self.binary, first + start, (stride, dtype.itemsize))
        if accessor.get("normalized"):
            array = np.maximum(array / np.iinfo(dtype).max, -1)
        return array.astype(np.float32)


def _local_matrix(node: dict[str, Any]) -> Array:
    """Make the matrix (4, 4) of a node: its matrix, by columns, or its translation, rotation (xyzw) and scale."""
    from scipy.spatial.transform import Rotation

    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
    else:
        matrix = np.eye(4)
        turn = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
        matrix[:3, :3] = turn * np.array(node.get("scale", [1.0, 1.0, 1.0]), np.float64)
        matrix[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    if not np.isfinite(matrix).all():
        raise ValueError(f"a node's matrix {matrix.tolist()}")
    return matrix
