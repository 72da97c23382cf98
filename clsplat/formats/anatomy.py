"""The anatomy of a file of Gaussians: format and version, bytes by part, comments.

There is a function for each format that `clsplat.formats` reads. The functions expect files that
`clsplat.formats.load_gaussians` has read without an error.
"""

import json
import struct
import warnings
import zipfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clsplat.formats import compressed_ply, gltf, ksplat, ply, sog, splat, spz, streamed_sog, tiles_3d
from clsplat.formats.axes import RIGHT_UP_BACK, turned
from clsplat.formats.glb_container import DTYPES, WIDTHS
from clsplat.formats.ply_container import read_header
from clsplat.formats.spz_container import HEADER, RDF, TABLE_ROW, read_container


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
    header, planes = read_container(path)
    if zipped:
        sizes = [len(plane) for plane in planes]
    else:
        last = HEADER.unpack_from(data)[-1]
        (start,) = struct.unpack_from("<I", data, HEADER.size)
        sizes = [TABLE_ROW.unpack_from(data, start + TABLE_ROW.size * i)[0] for i in range(last)]
    parts = {name: size for name, size in zip(names, sizes, strict=False) if size}
    packing = "gzip" if zipped else "Zstandard"
    comments = [f"positions have {header.bits} fractional bits", _axes(path, header.axes)]
    return Anatomy(f"SPZ (Niantic), version {header.version}, {packing}", parts, packed=zipped, comments=comments)


AXIS_NAMES = {"rub": "right, up, back", "rdf": "right, down, forward"}
"""The axes of an .spz in words."""


def _axes(path: Path, recorded: int | None) -> str:
    """Say which axes an .spz has: those that it records, or the specified ones and what the scene suggests."""
    if recorded:
        words = {1: "left, down, back", 4: AXIS_NAMES["rub"], RDF: AXIS_NAMES["rdf"], 7: "left, up, forward"}
        return f"axes recorded as {words[recorded]}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the file was read before
        guess = spz.guessed_axes(turned(spz.load_spz(path, "rub")[0], RIGHT_UP_BACK))
    read = f"axes not recorded, read as {AXIS_NAMES['rub']} as specified"
    if guess is None:
        return f"{read}; the scene does not tell"
    if guess == "rub":
        return f"{read}; so its level surfaces suggest"
    return f"{read}, but its level surfaces suggest {AXIS_NAMES[guess]}: export --spz-axes {guess} reads it so"


def glb_anatomy(path: Path) -> Anatomy:
    document = gltf.SplatDocument(path, path.read_bytes())
    names = {"POSITION": "means", "SCALE": "scales", "ROTATION": "quaternions", "OPACITY": "opacities"}
    names["SH_DEGREE_0_COEF_0"] = "colours (sh of band 0)"
    parts: Counter[str] = Counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the file was read before
        primitives = [primitive for primitive, _ in document.primitives()]
    for primitive in primitives:
        packed, attributes = gltf.spz_view(primitive), primitive["attributes"]
        if packed is not None:
            parts["all values, as .spz"] += len(document.view(packed))
            continue
        for name in gltf.attribute_names(attributes):
            accessor = document.json["accessors"][attributes[name]]
            row = WIDTHS[accessor["type"]] * DTYPES[accessor["componentType"]].itemsize
            parts[names.get(name.rpartition(":")[2], "sh above band 0")] += accessor["count"] * row
    parts["JSON and other data"] = max(0, path.stat().st_size - sum(parts.values()))
    generator = document.json["asset"].get("generator")
    comments = [f"generator: {generator}"] if generator else []
    return Anatomy("glTF 2.0 (.glb), KHR_gaussian_splatting", dict(parts), comments=comments)


def ksplat_anatomy(path: Path) -> Anatomy:
    data = path.read_bytes()
    header, sections = ksplat.read_sections(path, data)
    names = {"means": "means", "scales": "scales", "quats": "quaternions", "rgba": "colours and opacities"}
    names["sh"] = "sh above band 0"
    parts: Counter[str] = Counter()
    for section in sections:
        for column in section.row.names or ():
            parts[names[column]] += int(section.header["count"]) * section.row[column].itemsize
    parts["headers, buckets and empty rows"] = len(data) - sum(parts.values())
    kind = f".ksplat (mkkellogg), compression level {header['level']}"
    return Anatomy(kind, {name: size for name, size in parts.items() if size})


def streamed_sog_anatomy(path: Path) -> Anatomy:
    folder, meta, _ = streamed_sog.read_tree(path)
    parts: Counter[str] = Counter({streamed_sog.LOD_META: (folder / streamed_sog.LOD_META).stat().st_size})
    names = [*meta["filenames"], *([meta["environment"]] if "environment" in meta else [])]
    for name in dict.fromkeys(names):
        if (folder / name).exists():  # a copy may hold the finest level only
            parts.update(sog_anatomy(folder / name).parts)
    levels = meta.get("lodLevels", "some")
    return Anatomy(f"streamed SOG (PlayCanvas), {levels} levels of detail", dict(parts))


def tiles_anatomy(path: Path) -> Anatomy:
    folder, names = tiles_3d.read_tileset(path)
    parts: Counter[str] = Counter({tiles_3d.TILESET: (folder / tiles_3d.TILESET).stat().st_size})
    for name in names:
        parts.update(glb_anatomy(folder / name).parts)
    return Anatomy("3D Tiles of .glb, KHR_gaussian_splatting, the finest tiles", dict(parts))


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
