"""The .glb of glTF 2.0 with the extension KHR_gaussian_splatting, ratified by Khronos.

A file is a chunk of JSON and a chunk of numbers. A primitive of points has an attribute (an array with a row per
Gaussian) for each part:

* ``POSITION``;
* ``KHR_gaussian_splatting:ROTATION``: quaternions xyzw;
* ``KHR_gaussian_splatting:SCALE``: standard deviations, not their logarithms;
* ``KHR_gaussian_splatting:OPACITY``: 0 to 1;
* ``KHR_gaussian_splatting:SH_DEGREE_l_COEF_n``: RGB coefficients of the spherical harmonics;
* ``COLOR_0``: colours of band 0 with opacities, for viewers that only know points.

The axes of glTF are left, up, forward; those of a PLY are right, down, forward. The format has no place for the
rendering mode and the offset of a geo-referenced world: clsplat keeps them in the extras of the asset.
Source: the specification, https://github.com/KhronosGroup/glTF (extensions/2.0/Khronos/KHR_gaussian_splatting).
"""

import io
import json
import warnings
from collections.abc import Container, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import SH_C0, SH_DEGREE_MAX
from clsplat.errors import InputError
from clsplat.formats.axes import LEFT_UP_FORWARD, rotated, turned
from clsplat.formats.glb_container import ARRAY_BUFFER, CHUNK, DTYPES, HEADER, SIZE_MAX, WIDTHS, GlbDocument
from clsplat.formats.quantisation import check_expansion, checked, logs_of
from clsplat.formats.spz import decode
from clsplat.formats.spz_container import unpack
from clsplat.formats.validity import LOGIT_MAX, check_finite, checked_offset, reading
from clsplat.gaussians import Gaussians, logit, sigmoid

Array = NDArray[Any]

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSION = "KHR_gaussian_splatting_compression_spz_2"
READABLE = {EXTENSION, SPZ_EXTENSION, "KHR_mesh_quantization"}
"""Extensions that a file may require: the last one only allows integers as positions."""

DISPLAY_SRGB = "srgb_rec709_display"
"""Colour space of scenes trained from photos; the other one of the specification is linear."""

SHEAR_MAX = 1e-4
"""Deviation, relative to the squared scale, of a node's matrix from a rotation with a uniform scale. Exporters write
single precision."""


def load_glb(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read the Gaussians of all meshes of the scene of a .glb file, placed as its nodes say.

    Returns
    -------
    gaussians, mode, offset
        As in `clsplat.formats.load_gaussians`, in the axes of a PLY: x and y have the opposite sign of those in the
        file. Mode and offset are the default unless clsplat wrote the file.

    Raises
    ------
    InputError
        If the file cannot be read, is not a glTF 2.0 in binary, is truncated, holds no Gaussian or values that are
        not finite, requires other extensions, or places Gaussians by a shear or a mirror.
    """
    with reading(path):
        data = Path(path).read_bytes()
    # Values that overflow are rejected at the end; the logits of 0 and 1 are infinite before they are clamped.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        try:
            return SplatDocument(path, data).load()
        except (AttributeError, ArithmeticError, LookupError, TypeError, ValueError, RecursionError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"cannot read {path}: its JSON is incomplete or damaged: {error!r}") from error


def save_glb(path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Write Gaussians as a .glb file in float32, in their order; nothing is quantised.

    Parameters
    ----------
    path, gaussians, mode, offset
        As in `clsplat.formats.save_gaussians`. The mode and the offset go to the extras of the asset, which other
        programs ignore.

    Raises
    ------
    InputError
        If there is no Gaussian, a value or scale is not finite as float32, the file would be larger than 4 GiB, or
        it cannot be written.
    """
    g = turned(checked(path, gaussians), LEFT_UP_FORWARD)
    with np.errstate(over="ignore"):
        scales = g.scales
    if not np.isfinite(scales).all():
        raise InputError(f"{path}: expected scales that float32 can hold, found log_scales = {g.log_scales.max()}")
    opacities = sigmoid(g.logit_opacities.astype(np.float64))[:, None]
    colors = np.concatenate([0.5 + SH_C0 * g.sh[:, 0], opacities], axis=1)
    columns = {
        "POSITION": g.means,
        "COLOR_0": np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8),
        f"{EXTENSION}:ROTATION": np.roll(g.quats, -1, axis=1),
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities.astype(np.float32),
        **{name: g.sh[:, k] for k, name in enumerate(coefficients(g.sh_degree))},
    }
    text = json.dumps(_describe(columns, own_extras(mode, offset)), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    numbers = sum(column.nbytes for column in columns.values())
    total = HEADER.size + 2 * CHUNK.size + len(text) + numbers
    if total > SIZE_MAX:
        raise InputError(f"{path}: expected at most {SIZE_MAX} bytes, which a .glb can have, found {total}; use .spz")
    with replacing(path) as out:
        out.write(HEADER.pack(b"glTF", 2, total) + CHUNK.pack(len(text), b"JSON") + text)
        out.write(CHUNK.pack(numbers, b"BIN\0"))
        for column in columns.values():
            out.write(np.ascontiguousarray(column).tobytes())


def coefficients(degree: int) -> list[str]:
    """Names of the attributes of the spherical harmonics up to a degree, in our order."""
    return [f"{EXTENSION}:SH_DEGREE_{band}_COEF_{n}" for band in range(degree + 1) for n in range(2 * band + 1)]


def attribute_names(attributes: Container[str]) -> list[str]:
    """Names of the attributes that make up Gaussians of the degree of these attributes."""
    bands = range(1, SH_DEGREE_MAX + 1)
    degree = max((band for band in bands if f"{EXTENSION}:SH_DEGREE_{band}_COEF_0" in attributes), default=0)
    shape = [f"{EXTENSION}:{name}" for name in ("SCALE", "ROTATION", "OPACITY")]
    return ["POSITION", *shape, *coefficients(degree)]


def own_extras(mode: Mode, offset: ArrayLike | None) -> dict[str, Any]:
    """Make the part of the asset that holds a rendering mode and an offset; empty if both are the default."""
    own: dict[str, Any] = {"mode": mode} if mode != "classic" else {}
    shift = checked_offset(offset)
    if shift.any():
        own["offset"] = shift.tolist()
    return {"extras": {"clsplat": own}} if own else {}


def _describe(columns: dict[str, Array], own: dict[str, Any]) -> dict[str, Any]:
    """Make the JSON for arrays that follow each other in the chunk of numbers."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    at = 0
    for column in columns.values():
        views.append({"buffer": 0, "byteOffset": at, "byteLength": column.nbytes, "target": ARRAY_BUFFER})
        kind = next(name for name, width in WIDTHS.items() if width == column.shape[1])
        code = next(code for code, dtype in DTYPES.items() if dtype == column.dtype)
        accessor = {"bufferView": len(accessors), "componentType": code, "count": len(column), "type": kind}
        accessors.append(accessor | ({"normalized": True} if column.dtype == np.uint8 else {}))
        at += column.nbytes
    means = columns["POSITION"]
    accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    primitive = {
        "attributes": {name: k for k, name in enumerate(columns)},
        "mode": 0,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": DISPLAY_SRGB}},
    }
    return {
        "asset": {"version": "2.0", "generator": "clsplat"} | own,
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }


def spz_view(primitive: dict[str, Any]) -> int | None:
    """Index of the buffer view with the .spz of a primitive; None if it is not compressed."""
    spz = primitive["extensions"][EXTENSION].get("extensions", {}).get(SPZ_EXTENSION)
    return None if spz is None else spz["bufferView"]


class SplatDocument(GlbDocument):
    """A .glb of Gaussians that is being read."""

    unpacked = 0
    """Bytes of the Gaussians read so far."""

    def load(self) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
        foreign = set(self.json.get("extensionsRequired", [])) - READABLE
        if foreign:
            raise InputError(
                f"{self.path}: expected {EXTENSION} without further extensions, found that it requires "
                f"{', '.join(sorted(foreign))}; export it without compression"
            )
        parts = [self.gaussians(primitive, matrix) for primitive, matrix in self.primitives()]
        if not parts:
            raise InputError(f"{self.path}: expected a primitive with {EXTENSION}, found none; is it a mesh?")
        whole = parts[0] if len(parts) == 1 else Gaussians.concatenate(parts)
        extras = self.json["asset"].get("extras")  # data of any application
        own = extras.get("clsplat", {}) if isinstance(extras, dict) else {}
        mode: Mode = "antialiased" if own.get("mode") == "antialiased" else "classic"
        offset = np.asarray(own.get("offset", np.zeros(3)), np.float64)
        if offset.shape != (3,) or not np.isfinite(offset).all():
            raise ValueError(f"offset {own['offset']}")
        return check_finite(self.path, turned(whole, LEFT_UP_FORWARD).astype(np.float32)), mode, offset

    def primitives(self) -> Iterator[tuple[dict[str, Any], Array]]:
        """Yield the primitives of Gaussians with the matrices (4, 4) that place them."""
        for mesh, matrix in self.meshes():
            for primitive in self.json["meshes"][mesh]["primitives"]:
                extension = primitive.get("extensions", {}).get(EXTENSION)
                if extension is None:
                    continue
                known = extension.get("kernel", "ellipse") == "ellipse"
                if not known or extension.get("colorSpace", DISPLAY_SRGB) != DISPLAY_SRGB:
                    warnings.warn(
                        f"{self.path}: the kernel {extension.get('kernel')!r} with colours in "
                        f"{extension.get('colorSpace')!r} is read as ellipse in {DISPLAY_SRGB}",
                        stacklevel=2,
                    )
                yield primitive, matrix

    def gaussians(self, primitive: dict[str, Any], matrix: Array) -> Gaussians:
        """Read a primitive and place it."""
        packed = spz_view(primitive)
        if packed is not None:
            data = self.view(packed)
            whole = decode(self.path, *unpack(self.path, io.BytesIO(data), len(data)))
            return self.placed(checked(self.path, whole.astype(np.float32)), matrix)
        attributes = primitive["attributes"]
        names = attribute_names(attributes)
        missing = [name for name in names if name not in attributes]
        if missing:
            raise InputError(f"{self.path}: expected attributes of Gaussians, missing {', '.join(missing)}")
        counts = {self.json["accessors"][attributes[name]]["count"] for name in names}
        if len(counts) > 1 or min(counts) < 1:
            raise InputError(f"{self.path}: expected as many rows in each attribute, found {sorted(counts)}")
        self.unpacked += 4 * min(counts) * 3 * len(names)
        check_expansion(self.path, self.unpacked, self.size)
        widths = [3, 3, 4, 1] + [3] * (len(names) - 4)
        means, scales, quats, opacities, *sh = (
            self.rows(name, attributes[name], width) for name, width in zip(names, widths, strict=True)
        )
        logits = logit(np.clip(opacities[:, 0].astype(np.float64), 0, 1))
        gaussians = Gaussians(
            means,
            logs_of(scales),
            np.roll(quats, 1, axis=1),
            np.clip(logits, -LOGIT_MAX, LOGIT_MAX),
            np.stack(sh, axis=1),
        )
        return self.placed(checked(self.path, gaussians), matrix)

    def placed(self, gaussians: Gaussians, matrix: Array) -> Gaussians:
        """Move Gaussians by a rotation with a uniform scale and a shift."""
        if np.array_equal(matrix, np.eye(4)):
            return gaussians
        squared = matrix[:3, :3].T @ matrix[:3, :3]
        scale2 = np.trace(squared) / 3
        skewed = not np.abs(squared - scale2 * np.eye(3)).max() <= SHEAR_MAX * scale2
        if skewed or not np.linalg.det(matrix[:3, :3]) > 0:
            raise InputError(
                f"{self.path}: expected nodes that rotate, shift and scale alike in all directions, found the matrix "
                f"{matrix.tolist()}; apply it in the program that wrote the file"
            )
        scale = scale2**0.5
        turn = rotated(gaussians, matrix[:3, :3] / scale)
        return replace(
            turn,
            means=(turn.means * scale + matrix[:3, 3]).astype(np.float32),
            log_scales=(turn.log_scales + np.log(scale)).astype(np.float32),
        )
