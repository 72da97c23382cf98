"""The SOG of PlayCanvas (spatially ordered Gaussians): images in lossless WebP, one pixel per Gaussian.

A ``.sog`` file is a ZIP of ``meta.json`` and the images that it names; a folder with the same files is read as well.
Version 2, which is written, has these images:

* ``means_l`` and ``means_u``: low and high bytes of 16-bit fractions, each axis relative to its range of
  sign(x) ln(1 + \\|x\\|);
* ``quats``: the three smallest components of wxyz, and 252 plus the index of the largest;
* ``scales``: indices into a codebook of 256 log scales;
* ``sh0``: indices into a codebook of 256 coefficients of band 0, and the opacity;
* ``shN_labels``: 16-bit indices into a palette of the higher bands;
* ``shN_centroids``: the palette, 64 entries per row, as indices into a third codebook.

Version 1 has ranges instead of codebooks.
Source: the specification, https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog.
"""

import io
import json
import math
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.constants import SH_DEGREE_MAX
from clsplat.errors import InputError
from clsplat.formats.codebook import CODES, codebook, nearest, palette
from clsplat.formats.quantisation import (
    SQRT1_2,
    check_expansion,
    checked,
    file_size,
    from_smallest_three,
    logits_of,
    morton_order,
    opacity_bytes,
    smallest_three,
)
from clsplat.formats.sog_images import Images, webp
from clsplat.formats.validity import LOGIT_MAX, check_finite, checked_offset, reading
from clsplat.gaussians import Gaussians

Array = NDArray[Any]
Reader = Callable[[str], bytes]

META = "meta.json"
"""Name of the file that describes the scene."""

ROW = 64
"""Number of entries of the palette per row of its image."""

QUAT_TAG = 252
"""Alpha of a quaternion whose largest component is w; 253 to 255 stand for x, y, z."""


def load_sog(path: str | Path) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
    """Read Gaussians from a .sog file, from a folder with its content, or from the meta.json in it.

    Returns
    -------
    gaussians, mode, offset
        As in `clsplat.formats.load_gaussians`, in the order of the file. The offset is zero unless clsplat wrote the
        file.

    Raises
    ------
    InputError
        If the file cannot be read, is not a SOG of version 1 or 2, is truncated, lacks images or numbers, holds no
        Gaussian or values that are not finite, or declares more than a file of its size can hold.
    """
    path = Path(path)
    # Values that overflow are rejected at the end.
    with reading(path), np.errstate(over="ignore", invalid="ignore"):
        try:
            if path.is_dir() or path.name == META:
                folder = path if path.is_dir() else path.parent
                return _Decoder(path, lambda name: (folder / name).read_bytes()).decode()
            with zipfile.ZipFile(path) as archive:
                return _Decoder(path, _zip_reader(path, archive)).decode()
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError) as error:
            raise InputError(f"cannot read {path} as a ZIP: {error}") from error
        except (AttributeError, KeyError, IndexError, OverflowError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"cannot read {path}: its {META} or the images are incomplete: {error!r}") from error


def save_sog(path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Write Gaussians as a .sog file of version 2, sorted along a Z-order curve.

    Largest rounding errors: positions 1/131070 of the range of ln(1 + \\|x\\|) of their axis; quaternions 1/360 for
    each component other than the largest; opacities 1/510. Log scales and the sh of band 0 become the nearest of 256
    values, which are dense where most values are; the error is at most 1/256 of their range. Higher bands become the
    nearest row of a palette of up to 65536 entries. Nothing is clamped.

    Parameters
    ----------
    path, gaussians, mode, offset
        As in `clsplat.formats.save_gaussians`.

    Raises
    ------
    InputError
        If there is no Gaussian, a value is not finite as float32, or the file cannot be written.
    """
    g = checked(path, gaussians)
    with replacing(path) as out:
        write_sog(out, g, mode, offset)


def write_sog(out: BinaryIO, g: Gaussians, mode: Mode, offset: ArrayLike | None) -> None:
    """Write checked Gaussians to an open file, as `save_sog` does."""
    images, meta = _encode(g.take(morton_order(g.means)), mode, offset)
    # ZipInfo defaults to the earliest date of a ZIP, so that the same Gaussians give the same bytes.
    with zipfile.ZipFile(out, "w") as archive:
        for name, image in images.items():
            archive.writestr(zipfile.ZipInfo(name), webp(image))
        archive.writestr(zipfile.ZipInfo(META), json.dumps(meta))


def save_sog_folder(folder: Path, gaussians: Gaussians, mode: Mode, offset: ArrayLike | None) -> None:
    """Write the files of a SOG scene to a folder, in the order of the Gaussians, with meta.json as the last one.

    Parameters
    ----------
    folder : Path
        Created if it is missing; its parent must exist.
    gaussians, mode, offset
        As given to `save_sog`, which has the errors too.
    """
    images, meta = _encode(checked(folder, gaussians), mode, offset)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create {folder}: {error.strerror or error}") from error
    for name, image in images.items():
        with replacing(folder / name) as file:
            file.write(webp(image))
    with replacing(folder / META) as file:
        file.write(json.dumps(meta).encode())


def _encode(g: Gaussians, mode: Mode, offset: ArrayLike | None) -> tuple[dict[str, Array], dict[str, Any]]:
    """The images of a scene by name, and the content of its meta.json."""
    images = Images(len(g))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "clsplat"},
        "count": len(g),
        "antialias": mode == "antialiased",
        "means": _encode_means(g.means, images),
        "scales": _encode_by_codebook("scales", g.log_scales, images),
        "quats": _encode_quats(g.quats, images),
        "sh0": _encode_by_codebook("sh0", g.sh[:, 0], images, opacity_bytes(g)[:, None]),
    }
    if g.sh_degree:
        meta["shN"] = _encode_bands(g, images)
    shift = checked_offset(offset)
    if shift.any():
        meta["extras"] = {"clsplat": {"offset": shift.tolist()}}
    return images.files, meta


def _encode_means(means: Array, images: Images) -> dict[str, Any]:
    logs = np.sign(means) * np.log1p(np.abs(means, dtype=np.float64))
    low, high = logs.min(axis=0), logs.max(axis=0)
    fixed = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    files = [images.add("means_l", fixed & 255), images.add("means_u", fixed >> 8)]
    return {"mins": low.tolist(), "maxs": high.tolist(), "files": files}


def _encode_quats(quats: Array, images: Images) -> dict[str, Any]:
    largest, others = smallest_three(quats)
    codes = np.rint(255 * (0.5 + others * SQRT1_2)).astype(np.uint8)
    return {"files": [images.add("quats", codes, QUAT_TAG + largest[:, None])]}


def _encode_by_codebook(name: str, values: Array, images: Images, *alpha: Array) -> dict[str, Any]:
    book = codebook(values)
    return {"codebook": book.tolist(), "files": [images.add(name, nearest(book, values), *alpha)]}


def _encode_bands(g: Gaussians, images: Images) -> dict[str, Any]:
    """Encode the bands above 0 by a palette."""
    n = len(g)
    entries, labels = palette(g.sh[:, 1:].reshape(n, -1), _importance(g))
    codes = codebook(entries)
    pixels = np.full((ROW * math.ceil(len(entries) / ROW), g.sh.shape[1] - 1, 4), 255, np.uint8)
    pixels[: len(entries), :, :3] = nearest(codes, entries).reshape(len(entries), -1, 3)
    images.files["shN_centroids.webp"] = pixels.reshape(len(pixels) // ROW, -1, 4)
    low, high = labels[:, None] & 255, labels[:, None] >> 8
    return {
        "count": len(entries),
        "bands": g.sh_degree,
        "codebook": codes.tolist(),
        "files": ["shN_centroids.webp", images.add("shN_labels", low, high, np.zeros((n, 1), np.uint8))],
    }


def _importance(gaussians: Gaussians) -> Array:
    """Compute the weights of the Gaussians' colours in the palette, (N,) float32, positive.

    A weight is the root of the largest cross-section times opacity. Measurement: docs/formats.md.
    """
    largest = np.sort(gaussians.log_scales, axis=1)[:, 1:].sum(axis=1)
    logs = (largest + np.log(np.maximum(gaussians.opacities, 1e-3))) / 2
    return np.exp(np.maximum(logs - logs.max(), -30)).astype(np.float32)


def _zip_reader(path: Path, archive: zipfile.ZipFile) -> Reader:
    """Make a function that reads a file of the archive, from the folder that contains meta.json."""
    places = [name for name in archive.namelist() if name.rsplit("/", 1)[-1] == META]
    if len(places) != 1:
        raise InputError(f"{path}: expected one {META} in the ZIP, found {len(places)}; it is not a SOG scene")
    check_expansion(path, sum(entry.file_size for entry in archive.infolist()), file_size(path))
    return lambda name: archive.read(places[0].removesuffix(META) + name)


class _Decoder:
    """A SOG scene that is being read.

    Its methods raise an InputError for values that contradict each other, and other exceptions for missing ones.
    """

    def __init__(self, path: Path, read: Reader) -> None:
        self.path, self.read = path, read
        self.meta = json.loads(read(META))
        self.version = self.meta.get("version", 1) if isinstance(self.meta, dict) else None
        if self.version not in (1, 2):
            raise InputError(f"{path}: expected a SOG scene of version 1 or 2, found version {self.version!r}")
        self.count = self.meta["count"] if self.version == 2 else self.meta["means"]["shape"][0]
        if not isinstance(self.count, int) or self.count < 1:
            raise InputError(f"{path}: expected at least one Gaussian, found {self.count!r}")

    def decode(self) -> tuple[Gaussians, Mode, NDArray[np.float64]]:
        low, high = self.ranges("means", 3)
        fractions = (self.pixels("means")[:, :3] + 256.0 * self.pixels("means", 1)[:, :3]) / 65535
        logs = low + (high - low) * fractions
        quats = self.pixels("quats")
        if quats[:, 3].min() < QUAT_TAG:
            raise InputError(f"{self.path}: expected quaternions tagged {QUAT_TAG} to 255, found {quats[:, 3].min()}")
        base = self.pixels("sh0")
        if self.version == 2:
            sh0, logits = self.values("sh0", base[:, :3]), logits_of(base[:, 3])
        else:
            colors = self.values("sh0", base)
            sh0, logits = colors[:, :3], np.clip(colors[:, 3], -LOGIT_MAX, LOGIT_MAX)
        sh = sh0[:, None]
        gaussians = Gaussians(
            np.sign(logs) * np.expm1(np.abs(logs)),
            self.values("scales", self.pixels("scales")[:, :3]),
            from_smallest_three(quats[:, 3] - QUAT_TAG, (quats[:, :3] / 255 - 0.5) / SQRT1_2),
            logits,
            np.concatenate([sh, self.bands()], axis=1) if "shN" in self.meta else sh,
        ).astype(np.float32)
        mode: Mode = "antialiased" if self.meta.get("antialias") else "classic"
        return check_finite(self.path, gaussians), mode, self.offset()

    def bands(self) -> Array:
        """Decode the bands above 0, (N, K - 1, 3)."""
        labels = self.pixels("shN", 1)
        bank = self.image("shN")
        k = bank.shape[1] // ROW
        if k not in [(d + 1) ** 2 - 1 for d in range(1, SH_DEGREE_MAX + 1)] or bank.shape[1] % ROW:
            raise InputError(
                f"{self.path}: expected a palette of {ROW} times 3, 8 or 15 pixels width, found {bank.shape[1]}"
            )
        entries = self.values("shN", bank[:, :, :3].reshape(-1, k, 3))
        index = labels[:, 0].astype(np.intp) + 256 * labels[:, 1].astype(np.intp)
        if index.max() >= len(entries):
            raise InputError(f"{self.path}: expected labels below the palette's {len(entries)}, found {index.max()}")
        return np.asarray(entries[index])

    def offset(self) -> NDArray[np.float64]:
        extras = self.meta.get("extras")  # data of any application
        own = extras.get("clsplat", {}) if isinstance(extras, dict) else {}
        offset = np.asarray(own.get("offset", np.zeros(3)), np.float64)
        if offset.shape != (3,) or not np.isfinite(offset).all():
            raise ValueError(f"offset {own['offset']}")
        return offset

    def values(self, group: str, codes: Array) -> Array:
        """Convert bytes to values: entries of a codebook or, in version 1, fractions of a range."""
        if self.version == 2:
            book = np.asarray(self.meta[group]["codebook"], np.float32)
            if book.shape != (CODES,):
                raise InputError(
                    f"{self.path}: expected a codebook of {CODES} numbers for {group}, found {book.shape}"
                )
            return np.asarray(book[codes])
        low, high = self.ranges(group, codes.shape[-1])
        return np.asarray(low + (high - low) * (codes / 255), np.float32)

    def ranges(self, group: str, width: int) -> Array:
        """Read the range of each component, (2, width); (2,) for shN, which has a single range."""
        found = np.array([self.meta[group]["mins"], self.meta[group]["maxs"]], np.float64)
        expected = (2,) if group == "shN" else (2, width)
        if found.shape != expected:
            raise InputError(
                f"{self.path}: expected mins and maxs of {group} of shape {expected}, found {found.shape}"
            )
        return found

    def pixels(self, group: str, index: int = 0) -> Array:
        """Read an image with a pixel per Gaussian, (N, 4)."""
        image = self.image(group, index).reshape(-1, 4)
        if len(image) < self.count:
            raise InputError(
                f"{self.path}: expected {self.count} Gaussians as {META} declares, found {len(image)} pixels of "
                f"{group}"
            )
        return image[: self.count]

    def image(self, group: str, index: int = 0) -> Array:
        """Read an image, RGBA (H, W, 4), after checking that its size is plausible."""
        from PIL import Image, UnidentifiedImageError

        name = self.meta[group]["files"][index]
        if Path(name).name != name:
            raise InputError(f"{self.path}: expected images next to {META}, found {name!r}")
        data = self.read(name)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size is checked below
                image = Image.open(io.BytesIO(data), formats=["WEBP", "PNG"])
            with image:
                check_expansion(self.path, 4 * image.width * image.height, len(data))
                return np.asarray(image.convert("RGBA"))
        except (UnidentifiedImageError, Image.DecompressionBombError) as error:
            raise InputError(f"cannot read {self.path}: {name} is not a WebP image: {error}") from error
