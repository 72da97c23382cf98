"""The SOG of PlayCanvas (spatially ordered Gaussians): pictures in lossless WebP, one pixel for a Gaussian.

A ``.sog`` file is a ZIP of ``meta.json`` and the pictures it names; the same files in a folder are read, too.
Version 2, which is written: ``means_l`` and ``means_u`` hold the low and high bytes of 16-bit fractions of each axis'
range of sign(x) ln(1 + \\|x\\|); ``quats`` the three smallest components of wxyz and 252 plus the index of the
largest; ``scales`` indices into a codebook of 256 log scales; ``sh0`` indices into a codebook of 256 sh, and opacity;
``shN_labels`` 16-bit indices into a palette of higher bands, ``shN_centroids`` the palette, 64 entries in a row, as
indices into a third codebook. Version 1 has ranges instead of codebooks.
Source: the format's specification, https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog.
"""

import io
import json
import math
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import SH_DEGREE_MAX
from clsplat.errors import InputError
from clsplat.formats.codebook import CODES, codebook, nearest, palette
from clsplat.formats.ply import LOGIT_MAX, checked_offset
from clsplat.formats.quantisation import (
    SQRT1_2,
    check_expansion,
    check_finite,
    checked,
    file_size,
    from_smallest_three,
    logits_of,
    morton_order,
    opacity_bytes,
    smallest_three,
)
from clsplat.gaussians import Gaussians

Array = NDArray[Any]
Reader = Callable[[str], bytes]

META = "meta.json"
ROW = 64
"""Entries of the palette in a row of its picture."""

QUAT_TAG = 252
"""Alpha of a quaternion whose largest component is w; 253 to 255 are x, y, z."""

METHOD = 4
"""Effort of the WebP encoder: 6 takes four times as long for 1 % less."""


def load_sog(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a .sog file, from a folder with its content, or from the meta.json in it.

    Returns
    -------
    gaussians : Gaussians
        float32, in the order of the file.
    mode : {"classic", "antialiased"}
        What the file says.
    offset : (3,) float64
        What was subtracted from the world's coordinates, if clsplat wrote the file; otherwise zeros.

    Raises
    ------
    InputError
        If the file cannot be read, is no SOG of version 1 or 2, is truncated, lacks pictures or numbers, holds no
        Gaussian or values that are not finite, or declares more than a file of its size holds.
    """
    path = Path(path)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite in the end is refused then
            if path.is_dir() or path.name == META:
                folder = path if path.is_dir() else path.parent
                return _decode(path, lambda name: (folder / name).read_bytes())
            with zipfile.ZipFile(path) as archive:
                return _decode(path, _zip_reader(path, archive))
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError) as error:
        raise InputError(f"{path}: expected a whole .sog file, which is a ZIP, found: {error}") from error
    except (AttributeError, KeyError, IndexError, OverflowError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: expected the {META} of a SOG scene, found it lacking: {error!r}") from error
    except OSError as error:
        raise InputError(f"{path}: expected a readable SOG scene, found: {error.strerror or error}") from error


def save_sog(path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Write Gaussians as a .sog file of version 2, sorted along a Z-order curve.

    Rounded are positions to 1/131070 of their axis' range of ln(1 + \\|x\\|), quaternions to 1/360 for each component
    but the largest, opacities to 1/510; log scales and the sh of colours to the nearest of 256 values laid
    where most are, at worst 1/256 of their range away. Higher bands become the nearest of a palette of up to
    65536 entries. Nothing is clamped.

    Parameters
    ----------
    path : str or Path
        The file; its folder must exist.
    gaussians : Gaussians
        At least one, finite.
    mode : {"classic", "antialiased"}
        The rendering mode the scene was trained for.
    offset : (3,) array_like, optional
        What was subtracted from the world's coordinates, in world units.

    Raises
    ------
    InputError
        If there is no Gaussian, a value is not finite as float32, or the file cannot be written.
    """
    g = checked(path, gaussians)
    g = g.take(morton_order(g.means))
    n = len(g)
    width = 4 * math.ceil(math.sqrt(n) / 4)
    height = 4 * math.ceil(n / width / 4)
    files: dict[str, Array] = {}

    def picture(name: str, *columns: Array) -> str:
        pixels = np.full((height * width, 4), 255, np.uint8)
        for channel, column in enumerate(np.concatenate(columns, axis=1).T):
            pixels[:n, channel] = column
        files[f"{name}.webp"] = pixels.reshape(height, width, 4)
        return f"{name}.webp"

    logs = np.sign(g.means) * np.log1p(np.abs(g.means, dtype=np.float64))
    low, high = logs.min(axis=0), logs.max(axis=0)
    fixed = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    largest, others = smallest_three(g.quats)
    quats = np.rint(255 * (0.5 + others * SQRT1_2)).astype(np.uint8)
    scales, colors = codebook(g.log_scales), codebook(g.sh[:, 0])
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "clsplat"},
        "count": n,
        "antialias": mode == "antialiased",
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": [picture("means_l", fixed & 255), picture("means_u", fixed >> 8)],
        },
        "scales": {"codebook": scales.tolist(), "files": [picture("scales", nearest(scales, g.log_scales))]},
        "quats": {"files": [picture("quats", quats, QUAT_TAG + largest[:, None])]},
        "sh0": {
            "codebook": colors.tolist(),
            "files": [picture("sh0", nearest(colors, g.sh[:, 0]), opacity_bytes(g)[:, None])],
        },
    }
    if g.sh_degree:
        entries, labels = palette(g.sh[:, 1:].reshape(n, -1), _importance(g))
        codes = codebook(entries)
        pixels = np.full((ROW * math.ceil(len(entries) / ROW), g.sh.shape[1] - 1, 4), 255, np.uint8)
        pixels[: len(entries), :, :3] = nearest(codes, entries).reshape(len(entries), -1, 3)
        files["shN_centroids.webp"] = pixels.reshape(len(pixels) // ROW, -1, 4)
        meta["shN"] = {
            "count": len(entries),
            "bands": g.sh_degree,
            "codebook": codes.tolist(),
            "files": [
                "shN_centroids.webp",
                picture("shN_labels", labels[:, None] & 255, labels[:, None] >> 8, np.zeros((n, 1), np.uint8)),
            ],
        }
    shift = checked_offset(offset)
    if shift.any():
        meta["extras"] = {"clsplat": {"offset": shift.tolist()}}
    # Entries carry the earliest date there is, so that the same Gaussians give the same bytes.
    with replacing(path) as out, zipfile.ZipFile(out, "w") as archive:
        for name, image in files.items():
            archive.writestr(zipfile.ZipInfo(name), _webp(image))
        archive.writestr(zipfile.ZipInfo(META), json.dumps(meta))


def _zip_reader(path: Path, archive: zipfile.ZipFile) -> Reader:
    """A function that reads a file of the archive from the folder in which meta.json lies."""
    places = [name for name in archive.namelist() if name.rsplit("/", 1)[-1] == META]
    if len(places) != 1:
        raise InputError(f"{path}: expected one {META} in the ZIP, found {len(places)}; it is no SOG scene")
    check_expansion(path, sum(entry.file_size for entry in archive.infolist()), file_size(path))
    return lambda name: archive.read(places[0].removesuffix(META) + name)


def _decode(path: Path, read: Reader) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    meta = json.loads(read(META))
    version = meta.get("version", 1) if isinstance(meta, dict) else None
    if version not in (1, 2):
        raise InputError(f"{path}: expected a SOG scene of version 1 or 2, found version {version!r}")
    n = meta["count"] if version == 2 else meta["means"]["shape"][0]
    if not isinstance(n, int) or n < 1:
        raise InputError(f"{path}: expected at least one Gaussian, found {n!r}")

    def picture(group: str, index: int = 0) -> Array:
        return _pixels(path, read, meta[group]["files"][index])

    def pixels(group: str, index: int = 0) -> Array:
        image = picture(group, index).reshape(-1, 4)
        if len(image) < n:
            raise InputError(f"{path}: expected {n} Gaussians as {META} says, found {len(image)} pixels of {group}")
        return image[:n]

    def values(group: str, codes: Array) -> Array:
        """What bytes (N, 3 or 4) stand for: entries of a codebook or, in version 1, fractions of a range."""
        if version == 2:
            book = np.asarray(meta[group]["codebook"], np.float32)
            if book.shape != (CODES,):
                raise InputError(f"{path}: expected a codebook of {CODES} numbers for {group}, found {book.shape}")
            return book[codes]
        low, high = ends(group, codes.shape[-1])
        return (low + (high - low) * (codes / 255)).astype(np.float32)

    def ends(group: str, width: int) -> Array:
        """The range of each component, (2, width); (2,) for shN, which has one."""
        found = np.array([meta[group]["mins"], meta[group]["maxs"]], np.float64)
        expected = (2,) if group == "shN" else (2, width)
        if found.shape != expected:
            raise InputError(f"{path}: expected mins and maxs of {group} of shape {expected}, found {found.shape}")
        return found

    low, high = ends("means", 3)
    fractions = (pixels("means")[:, :3] + 256.0 * pixels("means", 1)[:, :3]) / 65535
    logs = low + (high - low) * fractions
    quats = pixels("quats")
    if quats[:, 3].min() < QUAT_TAG:
        raise InputError(f"{path}: expected quaternions tagged {QUAT_TAG} to 255, found {quats[:, 3].min()}")
    base = pixels("sh0")
    if version == 2:
        sh0, logits = values("sh0", base[:, :3]), logits_of(base[:, 3])
    else:
        colors = values("sh0", base)
        sh0, logits = colors[:, :3], np.clip(colors[:, 3], -LOGIT_MAX, LOGIT_MAX)
    sh = sh0[:, None]
    if "shN" in meta:
        labels = pixels("shN", 1)
        bank = picture("shN")
        k = bank.shape[1] // ROW
        if k not in [(d + 1) ** 2 - 1 for d in range(1, SH_DEGREE_MAX + 1)] or bank.shape[1] % ROW:
            raise InputError(
                f"{path}: expected a palette of {ROW} times 3, 8 or 15 pixels width, found {bank.shape[1]}"
            )
        entries = values("shN", bank[:, :, :3].reshape(-1, k, 3))
        index = labels[:, 0].astype(np.intp) + 256 * labels[:, 1].astype(np.intp)
        if index.max() >= len(entries):
            raise InputError(f"{path}: expected labels below the palette's {len(entries)}, found {index.max()}")
        sh = np.concatenate([sh, entries[index]], axis=1)
    gaussians = Gaussians(
        np.sign(logs) * np.expm1(np.abs(logs)),
        values("scales", pixels("scales")[:, :3]),
        from_smallest_three(quats[:, 3] - QUAT_TAG, (quats[:, :3] / 255 - 0.5) / SQRT1_2),
        logits,
        sh,
    ).astype(np.float32)
    extras = meta.get("extras")  # whatever an application wants to keep
    own = extras.get("clsplat", {}) if isinstance(extras, dict) else {}
    offset = np.asarray(own.get("offset", np.zeros(3)), np.float64)
    if offset.shape != (3,) or not np.isfinite(offset).all():
        raise ValueError(f"offset {own['offset']}")
    return check_finite(path, gaussians), "antialiased" if meta.get("antialias") else "classic", offset


def _pixels(path: Path, read: Reader, name: str) -> Array:
    """RGBA of a picture, (H, W, 4), once its size is known to be no bomb."""
    from PIL import Image, UnidentifiedImageError

    if Path(name).name != name:
        raise InputError(f"{path}: expected pictures beside {META}, found {name!r}")
    data = read(name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the check follows
            image = Image.open(io.BytesIO(data), formats=["WEBP", "PNG"])
        with image:
            check_expansion(path, 4 * image.width * image.height, len(data))
            return np.asarray(image.convert("RGBA"))
    except (UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: expected {name} to be a picture in WebP, found: {error}") from error


def _importance(gaussians: Gaussians) -> Array:
    """Weight of each Gaussian's colours, (N,) float32, positive: the root of its largest cross-section times opacity,
    which costs half the PSNR that equal weights, and less than the product itself."""
    largest = np.sort(gaussians.log_scales, axis=1)[:, 1:].sum(axis=1)
    logs = (largest + np.log(np.maximum(gaussians.opacities, 1e-3))) / 2
    return np.exp(np.maximum(logs - logs.max(), -30)).astype(np.float32)


def _webp(pixels: Array) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    # exact: without it colours are dropped where alpha, here a number like others, is 0.
    Image.fromarray(pixels).save(file, format="WEBP", lossless=True, exact=True, method=METHOD)
    return file.getvalue()
