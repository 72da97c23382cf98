"""What a file of Gaussians is made of: format and version, bytes of each part, comments.

For files that `clsplat.formats.load_gaussians` reads: damage is found there.
"""

import gzip
import json
import struct
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clsplat.formats import compressed_ply, ply, sog, splat, spz


@dataclass(frozen=True)
class Anatomy:
    """What a file is made of.

    Parameters
    ----------
    format : str
        Name and version, in words.
    parts : dict of int
        Bytes by part of the scene.
    packed : bool
        The parts are compressed together: their bytes are those before that.
    comments : list of str
        What the file says besides the Gaussians.
    """

    format: str
    parts: dict[str, int]
    packed: bool = False
    comments: list[str] = field(default_factory=list)


def _ply(path: Path) -> Anatomy:
    with open(path, "rb") as file:
        header, size = ply.read_header(path, file)
    elements, counts, order, comments = ply.parse_header(path, header)
    kind = {"<": "binary, little endian", ">": "binary, big endian", "=": "text"}[order]
    parts: Counter[str] = Counter({"header": len(header)})
    if order == "=":
        parts["rows of text"] = size - len(header)
        return Anatomy(f"PLY, {kind}", dict(parts), comments=comments)
    for (name, element), count in zip(elements.items(), counts, strict=True):
        dtype = element.dtype(order)
        for column in dtype.names or ():
            part = _part_of(column) if name == "vertex" else name
            parts[part] += count * dtype[column].itemsize
    parts["more"] = size - sum(parts.values())
    return Anatomy(f"PLY, {kind}", {name: n for name, n in parts.items() if n}, comments=comments)


def _part_of(column: str) -> str:
    """The parameter to which a property of a PLY's vertex belongs."""
    groups = {"means": ply.MEANS, "colours (sh of band 0)": ply.SH0, "opacities": ("opacity",)}
    groups |= {"scales": ply.LOG_SCALES, "quaternions": ply.QUATS, "normals, unused": ply.NORMALS}
    if column.startswith("f_rest_"):
        return "sh above band 0"
    return next((name for name, columns in groups.items() if column in columns), "other properties")


def _compressed_ply(path: Path) -> Anatomy:
    with open(path, "rb") as file:
        header, _ = ply.read_header(path, file)
    elements, counts, order, comments = ply.parse_header(path, header)
    rows = dict(zip(elements, counts, strict=True))
    names = {
        "packed_position": "means",
        "packed_rotation": "quaternions",
        "packed_scale": "scales",
        "packed_color": "colours and opacities",
    }
    parts = {"header": len(header), "ranges of chunks": rows["chunk"] * elements["chunk"].dtype(order).itemsize}
    parts |= {names[column]: rows["vertex"] * 4 for column in compressed_ply.PACKED}
    if "sh" in rows:
        parts["sh above band 0"] = rows["sh"] * elements["sh"].dtype(order).itemsize
    return Anatomy("compressed PLY (PlayCanvas)", parts, comments=comments)


def _splat(path: Path) -> Anatomy:
    count = path.stat().st_size // splat.ROW.itemsize
    names = {"means": "means", "scales": "scales", "rgb": "colours", "opacity": "opacities", "quats": "quaternions"}
    return Anatomy(".splat (antimatter15)", {name: count * splat.ROW[key].itemsize for key, name in names.items()})


def _spz(path: Path) -> Anatomy:
    names = ("means", "opacities", "colours (sh of band 0)", "scales", "quaternions", "sh above band 0")
    data = path.read_bytes()
    zipped = data[:2] == b"\x1f\x8b"
    if zipped:
        with gzip.open(path) as file:
            data = file.read(spz.HEADER.size)
    _, version, n, degree, bits, _, streams = spz.HEADER.unpack_from(data)
    comments = [f"positions have {bits} fractional bits"]
    if zipped:
        sizes = spz.plane_sizes(n, degree, version)
    else:
        (start,) = struct.unpack_from("<I", data, spz.HEADER.size)
        sizes = [struct.unpack_from("<Q", data, start + 16 * i)[0] for i in range(streams)]
    parts = {name: size for name, size in zip(names, sizes, strict=False) if size}
    packing = "gzip" if zipped else "Zstandard"
    return Anatomy(f"SPZ (Niantic), version {version}, {packing}", parts, packed=zipped, comments=comments)


def _sog(path: Path) -> Anatomy:
    if path.is_dir() or path.name == sog.META:
        folder, kind = path if path.is_dir() else path.parent, "in a folder"
        meta = json.loads((folder / sog.META).read_bytes())
        sizes = {name: (folder / name).stat().st_size for name in (sog.META, *_pictures(meta))}
    else:
        kind = "ZIP"
        with zipfile.ZipFile(path) as archive:
            entries = {entry.filename: entry.compress_size for entry in archive.infolist()}
            place = next(name for name in entries if name.rsplit("/", 1)[-1] == sog.META)
            meta = json.loads(archive.read(place))
        root = place.removesuffix(sog.META)
        sizes = {name: entries[root + name] for name in (sog.META, *_pictures(meta))}
    asset = meta.get("asset")
    comments = [f"generator: {asset['generator']}"] if isinstance(asset, dict) and "generator" in asset else []
    return Anatomy(f"SOG (PlayCanvas), version {meta.get('version', 1)}, {kind}", sizes, comments=comments)


def _pictures(meta: dict[str, Any]) -> list[str]:
    groups = (meta[group] for group in ("means", "scales", "quats", "sh0", "shN") if group in meta)
    return [name for group in groups for name in group["files"]]


ANATOMIES: dict[str, Callable[[Path], Anatomy]] = {
    ".ply": _ply,
    ".compressed.ply": _compressed_ply,
    ".splat": _splat,
    ".spz": _spz,
    ".sog": _sog,
}
"""By the suffixes of `clsplat.formats.FORMATS`."""
