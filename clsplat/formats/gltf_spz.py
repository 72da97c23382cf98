"""A .glb whose Gaussians are compressed as .spz: the extension KHR_gaussian_splatting_compression_spz_2.

The tiles of 3D Tiles are written so, as CesiumJS draws no others. The numbers are one .spz of version 3, in the axes
of glTF. Attributes have accessors without numbers, as in other compressions of glTF; opacities and band 0 are in
``COLOR_0``.
Source: the draft, https://github.com/CesiumGS/glTF (branch draft-splat-spz,
extensions/2.0/Khronos/KHR_gaussian_splatting_compression_spz_2), and the reader of CesiumJS 1.145.
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.formats.axes import LEFT_UP_FORWARD, turned
from clsplat.formats.glb_container import CHUNK, DTYPES, HEADER
from clsplat.formats.gltf import DISPLAY_SRGB, EXTENSION, SPZ_EXTENSION, coefficients, own_extras
from clsplat.formats.quantisation import checked
from clsplat.formats.spz import write_spz
from clsplat.gaussians import Gaussians

FLOAT = next(code for code, dtype in DTYPES.items() if dtype == np.float32)
BYTE = next(code for code, dtype in DTYPES.items() if dtype == np.uint8)


def save_spz_glb(path: Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Write Gaussians as a .glb that is compressed as .spz.

    Parameters
    ----------
    path, gaussians, mode, offset
        As in `clsplat.formats.save_gaussians`. Rounding errors and ranges are those of
        `clsplat.formats.spz.save_spz`; the mode and the offset go to the extras of the asset.

    Raises
    ------
    InputError
        As `save_spz`.
    """
    g = turned(checked(path, gaussians), LEFT_UP_FORWARD)
    packed = io.BytesIO()
    write_spz(path, packed, g, mode, version=3)
    numbers = packed.getvalue()
    text = json.dumps(_describe(g, len(numbers), own_extras(mode, offset)), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    numbers += bytes(-len(numbers) % 4)
    total = HEADER.size + 2 * CHUNK.size + len(text) + len(numbers)
    with replacing(path) as out:
        out.write(HEADER.pack(b"glTF", 2, total) + CHUNK.pack(len(text), b"JSON") + text)
        out.write(CHUNK.pack(len(numbers), b"BIN\0") + numbers)


def _describe(gaussians: Gaussians, size: int, extras: dict[str, Any]) -> dict[str, Any]:
    """Make the JSON for a chunk of numbers with an .spz of `size` bytes."""
    accessors: dict[str, dict[str, Any]] = {
        "POSITION": {"type": "VEC3", "min": gaussians.means.min(0).tolist(), "max": gaussians.means.max(0).tolist()},
        "COLOR_0": {"type": "VEC4", "componentType": BYTE, "normalized": True},
        f"{EXTENSION}:ROTATION": {"type": "VEC4"},
        f"{EXTENSION}:SCALE": {"type": "VEC3"},
        **{name: {"type": "VEC3"} for name in coefficients(gaussians.sh_degree)[1:]},
    }
    compressed = {SPZ_EXTENSION: {"bufferView": 0}}
    primitive = {
        "attributes": {name: k for k, name in enumerate(accessors)},
        "mode": 0,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": DISPLAY_SRGB, "extensions": compressed}},
    }
    return {
        "asset": {"version": "2.0", "generator": "clsplat"} | extras,
        "extensionsUsed": [EXTENSION, SPZ_EXTENSION],
        "extensionsRequired": [EXTENSION, SPZ_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": size}],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": size}],
        "accessors": [
            {"componentType": FLOAT, "count": len(gaussians)} | accessor for accessor in accessors.values()
        ],
    }
