"""Random changes to files that know what is inside: members of archives, arrays, chunks, pixels, values of JSON.

Bytes changed at random are mostly refused at the first checksum. These changes leave checksums and lengths right, so
that what is behind them is read.
"""

import gzip
import io
import json
import struct
import warnings
import zipfile
import zlib

import numpy as np
from damage import EXTREMES, JSON_VALUES, NUMBERS, changed, damaged
from PIL import Image

PNG = b"\x89PNG\r\n\x1a\n"
DEEP = 3000
"""Depth of nested lists: more than Python's parser of JSON descends into."""
DIGITS = 5000
"""Digits of an integer: more than Python converts from text."""
EDGE_MAX = 256
"""Pictures with longer edges are not decoded to change their pixels, which takes long."""
LONG_VALUES = [
    b"[" * DEEP + b"]" * DEEP,
    b'{"a":' * DEEP + b"1" + b"}" * DEEP,
    b"9" * DIGITS,
    b'"' + b"x" * DIGITS + b'"',
]
YAML = ["!!map [1]", "!!timestamp 2020-13-45", "&a [*a]", "!!binary x", "~", "- x", "? [1]", "<<: 3", "*n"]
"""Values of YAML that its parser makes into other objects than JSON has."""
MODES = ["1", "L", "LA", "P", "RGB", "RGBA", "I;16", "I", "F", "CMYK"]


def mutated(content, rng):
    """A changed copy of a file, by its kind.

    Parameters
    ----------
    content : bytes
    rng : random.Random
    """
    if content and rng.random() < 0.05:
        return raw(content, rng)
    for begins, change in KINDS:
        if content.startswith(begins):
            return change(content, rng)
    try:
        text = content.decode()
    except UnicodeDecodeError:
        return raw(content, rng)
    if "\0" in text or not text.strip():
        return raw(content, rng)
    try:
        return json_changed(json.loads(text), rng)
    except (ValueError, RecursionError):
        return lines_changed(content, rng)


def raw(content, rng):
    """Flip, overwrite, splice and cut bytes, and replace numbers in text."""
    place = lambda: rng.randrange(2**20)  # noqa: E731
    kinds = {
        "flip": lambda: ("flip", place(), rng.randrange(8)),
        "put": lambda: ("put", place(), rng.choice(EXTREMES)),
        "splice": lambda: ("splice", place(), place(), place()),
        "number": lambda: ("number", place(), rng.choice(NUMBERS)),
        "cut": lambda: ("cut", place()),
    }
    names = rng.choices([*kinds], [4, 6, 2, 2, 1], k=rng.choice([1, 1, 2, 4]))
    return damaged(content or b"\0", [kinds[name]() for name in names])


def zip_changed(content, rng):
    """Change, remove, copy and exchange members of a ZIP."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {info.filename: archive.read(info) for info in archive.infolist()}
    except Exception:  # a ZIP that is damaged already
        return raw(content, rng)
    if not members:
        return raw(content, rng)
    for _ in range(rng.choice([1, 1, 1, 2])):
        name, other, kind = rng.choice([*members]), rng.choice([*members]), rng.random()
        if kind < 0.9:
            members[name] = mutated(members[name], rng)
        elif kind < 0.94 and len(members) > 1:
            del members[name]
        elif kind < 0.98:
            members[name] = members[other]
        else:
            members[rng.choice([other + "x", "x/" + name, name.upper()])] = members[name]
    return packed(members)


def packed(members):
    """A ZIP of files by name, stored as they are, always the same for the same files."""
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w") as archive:
        warnings.simplefilter("ignore")  # two members with one name
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return file.getvalue()


def gzip_changed(content, rng):
    """Change what is compressed."""
    try:
        return gzip.compress(mutated(gzip.decompress(content), rng), 1, mtime=0)
    except (OSError, EOFError, zlib.error):
        return raw(content, rng)


def npy_changed(content, rng):
    """Change values, type and shape of an array; text in it by its own kind."""
    try:
        array = np.load(io.BytesIO(content))
    except Exception:  # an array that is damaged already
        return raw(content, rng)
    kind = rng.random()
    if array.dtype.kind == "U" and array.ndim == 0:
        array = np.array(mutated(str(array).encode(errors="replace"), rng).decode(errors="replace"))
    elif kind < 0.5 and array.size and array.dtype.kind in "fiub":
        array = array.copy()
        at = rng.randrange(array.size)
        data = bytearray(array.tobytes())
        new = rng.choice([e for e in EXTREMES if len(e) <= array.itemsize] or [b"\1"])
        data[at * array.itemsize : at * array.itemsize + len(new)] = new
        array = np.frombuffer(bytes(data), array.dtype).reshape(array.shape)
    elif kind < 0.65:
        if array.dtype.kind == "U":
            return raw(content, rng)
        with np.errstate(all="ignore"):
            array = array.astype(rng.choice(["f2", "f4", "f8", ">f4", "c8", "i4", "i8", "u1", "U3", "?"]), copy=True)
    elif kind < 0.8:
        array = np.concatenate([np.atleast_1d(array)] * 2) if rng.random() < 0.5 else np.atleast_1d(array)[:-1]
    elif kind < 0.95:
        array = rng.choice([lambda a: a.reshape(-1), lambda a: a[None], lambda a: a.T, lambda a: a[..., None]])(array)
    else:
        return raw(content, rng)
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def png_changed(content, rng):
    """Change chunks of a PNG, and give each its checksum."""
    if rng.random() < 0.3:
        return picture_changed(content, rng)
    chunks, at = [], len(PNG)
    while at + 12 <= len(content):
        size = struct.unpack_from(">I", content, at)[0]
        chunks.append([content[at + 4 : at + 8], content[at + 8 : at + 8 + size]])
        at += 12 + size
    if not chunks:
        return raw(content, rng)
    chosen, kind = rng.choice(chunks), rng.random()
    if kind < 0.6:
        chosen[1] = raw(chosen[1], rng)
    elif kind < 0.7 and chosen[0] == b"IDAT":
        try:
            chosen[1] = zlib.compress(raw(zlib.decompress(chosen[1]), rng), 1)
        except zlib.error:
            chosen[1] = raw(chosen[1], rng)
    elif kind < 0.85:
        names = [
            b"tRNS",
            b"PLTE",
            b"eXIf",
            b"gAMA",
            b"sRGB",
            b"iCCP",
            b"zTXt",
            b"tEXt",
            b"acTL",
            b"fcTL",
            b"pHYs",
            b"bKGD",
        ]
        chunks.insert(rng.randrange(len(chunks)), [rng.choice(names), rng.randbytes(rng.choice([0, 1, 2, 6, 40]))])
    elif kind < 0.93:
        chunks.remove(chosen)
    else:
        chunks.insert(rng.randrange(len(chunks) + 1), chosen)
    parts = (struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in chunks)
    return PNG + b"".join(parts)


def picture_changed(content, rng):
    """Change pixels, size, mode or EXIF data of a picture, and encode it again in its format."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = Image.open(io.BytesIO(content))
            if max(image.size) > EDGE_MAX:
                return raw(content, rng)
            kind, form, result = rng.random(), image.format, image.copy()
            exif = Image.Exif()
            if kind < 0.4:
                pixels = bytearray(result.tobytes())
                at = rng.randrange(len(pixels))
                new = rng.choice([rng.choice(EXTREMES), rng.randbytes(64)])
                pixels[at : at + len(new)] = new[: len(pixels) - at]
                result = Image.frombytes(result.mode, result.size, bytes(pixels))
            elif kind < 0.6:
                result = result.resize([max(1, e + rng.choice([-4, -1, 0, 1, 60])) for e in result.size])
            elif kind < 0.85:
                mode = rng.choice(MODES)
                result = (
                    Image.new(mode, result.size, rng.choice([0, 1, 255])) if mode == "I;16" else result.convert(mode)
                )
            else:
                exif[0x0112] = rng.choice([0, 1, 3, 6, 8, 9, 65535])
            file = io.BytesIO()
            lossless = {"lossless": True, "exact": True} if form == "WEBP" else {}
            result.save(file, format=form, exif=exif, **lossless)
            return file.getvalue()
    except Exception:  # a picture that is damaged already, or a mode that the format lacks
        return raw(content, rng)


def json_changed(value, rng):
    """Replace and remove values at any depth."""
    for _ in range(rng.choice([1, 1, 2, 3])):
        value = changed(value, rng.randrange(2**20), rng.choice([*JSON_VALUES, ...]))
    content = json.dumps(value).encode()
    return (
        damaged(content, [("number", rng.randrange(2**20), "@")]).replace(b"@", rng.choice(LONG_VALUES), 1)
        if (rng.random() < 0.03)
        else content
    )


def lines_changed(content, rng):
    """Change lines of text by their kind, remove and copy them, and change numbers and bytes."""
    lines = content.split(b"\n")
    at, kind = rng.randrange(len(lines)), rng.random()
    if kind < 0.3 and lines[at].startswith((b"{", b"[")):
        try:
            lines[at] = json_changed(json.loads(lines[at]), rng)
        except (ValueError, RecursionError):
            lines[at] = raw(lines[at], rng)
    elif kind < 0.5:
        return damaged(content, [("number", rng.randrange(2**20), rng.choice([*NUMBERS, *YAML]))])
    elif kind < 0.6:
        del lines[at]
    elif kind < 0.7:
        lines.insert(rng.randrange(len(lines)), lines[at])
    elif kind < 0.73:
        return damaged(content, [("number", rng.randrange(2**20), "@")]).replace(b"@", rng.choice(LONG_VALUES), 1)
    else:
        return raw(content, rng)
    return b"\n".join(lines)


KINDS = [
    (b"PK\x03\x04", zip_changed),
    (b"\x93NUMPY", npy_changed),
    (b"\x1f\x8b", gzip_changed),
    (PNG, png_changed),
    (b"RIFF", lambda c, rng: picture_changed(c, rng) if rng.random() < 0.4 else raw(c, rng)),
    (b"\xff\xd8", lambda c, rng: picture_changed(c, rng) if rng.random() < 0.2 else raw(c, rng)),
]
"""Beginning of a file, and how files of its kind are changed."""
