"""The anatomy of a file of Gaussians: format and version, bytes by part, comments.

There is a function for each format in `clsplat.formats.FORMATS`. The functions expect files that
`clsplat.formats.load_gaussians` has read without an error.
"""

import gzip
import json
import struct
import zipfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clsplat.formats import compressed_ply, ply, sog, splat, spz
from clsplat.formats.ply_container import read_header


@dataclass(frozen=True)
class Anatomy:
    """The parts of a file.

    Parameters
    ----------
    format : str
        Name and version of the format.
    parts : dict of int
        Bytes by part of the scene.
    packed : bool
        Whether the parts are compressed together; `parts` are then the bytes before compression.
    comments : list of str
        Comments and other information in the file.
    """

    format: str
    parts: dict[str, int]
    packed: bool = False
    comments: list[str] = field(default_factory=list)


def ply_anatomy(path: Path) -> Anatomy:
    with open(path, "rb") as file:
        header = read_header(path, file)
    kind = {"<": "binary, little endian", ">": "binary, big endian", "=": "text"}[header.order]
    parts: Counter[str] = Counter({"header": header.length})
    if header.order == "=":
        parts["rows of text"] = header.file_size - header.length
        return Anatomy(f"PLY, {kind}", dict(parts), comments=header.comments)
    for name, element in header.elements.items():
        dtype = element.dtype(header.order)
        for column in dtype.names or ():
            part = _part_of(column) if name == "vertex" else name
            parts[part] += header.rows[name] * dtype[column].itemsize
    parts["other data"] = header.file_size - sum(parts.values())
    return Anatomy(f"PLY, {kind}", {name: n for name, n in parts.items() if n}, comments=header.comments)


def _part_of(column: str) -> str:
    """Return the part of the scene to which a property of a PLY's vertex belongs."""
    groups = {"means": ply.MEANS, "colours (sh of band 0)": ply.SH0, "opacities": ("opacity",)}
    groups |= {"scales": ply.LOG_SCALES, "quaternions": ply.QUATS, "normals, unused": ply.NORMALS}
    if column.startswith("f_rest_"):
        return "sh above band 0"
    return next((name for name, columns in groups.items() if column in columns), "other properties")


def compressed_ply_anatomy(path: Path) -> Anatomy:
    with open(path, "rb") as file:
        header = read_header(path, file)
    elements, rows, order = header.elements, header.rows, header.order
    names = {
        "packed_position": "means",
        "packed_rotation": "quaternions",
        "packed_scale": "scales",
        "packed_color": "colours and opacities",
    }
    parts = {"header": header.length, "ranges of chunks": rows["chunk"] * elements["chunk"].dtype(order).itemsize}
    parts |= {names[column]: rows["vertex"] * 4 for column in compressed_ply.PACKED}
    if "sh" in rows:
        parts["sh above band 0"] = rows["sh"] * elements["sh"].dtype(order).itemsize
    return Anatomy("compressed PLY (PlayCanvas)", parts, comments=header.comments)


def splat_anatomy(path: Path) -> Anatomy:
    count = path.stat().st_size // splat.ROW.itemsize
    names = {"means": "means", "scales": "scales", "rgb": "colours", "opacity": "opacities", "quats": "quaternions"}
    return Anatomy(".splat (antimatter15)", {name: count * splat.ROW[key].itemsize for key, name in names.items()})


def spz_anatomy(path: Path) -> Anatomy:
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


def sog_anatomy(path: Path) -> Anatomy:
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
