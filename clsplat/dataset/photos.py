"""Photos as files: which there are, how large they are, and their pixels as 8-bit RGB."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from clsplat.errors import InputError

HEIF = (".heic", ".heif")
"""Endings, in lower case, of photos that are read by pillow-heif."""

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", *HEIF)
"""Endings, in lower case, of the files that count as photos."""

SHARPNESS_EDGE = 640
"""Longer edge, in pixels, of the copies whose sharpness is compared: motion blurs wider than this, noise is finer."""

FRAMES = "clsplat_frames.json"
"""File among photos that are the frames of a video, in the order of their names: which video, and how they were
chosen."""

TRANSPARENT = ("RGBA", "RGBa", "LA", "La", "PA")
"""Pillow's modes with an alpha channel."""


def photo_folder(path: Path) -> Path:
    """Where the photos of the dataset `path` are: its folder ``images``, or `path` itself where there is none."""
    return path / "images" if (path / "images").is_dir() else path


def list_photos(path: Path) -> list[str]:
    """Names of the photos of the dataset `path`, sorted, relative to `photo_folder`, with forward slashes.

    Sub-folders count inside ``images`` only: elsewhere they may hold masks, smaller copies and results.
    """
    folder = photo_folder(path)
    files = folder.glob("*") if folder == path else folder.rglob("*")
    return sorted(
        file.relative_to(folder).as_posix()
        for file in files
        if file.suffix.lower() in SUFFIXES and not file.name.startswith(".") and file.is_file()
    )


@cache
def heif_is_read() -> bool:
    """Teach Pillow to read HEIF, where pillow-heif is installed; such photos come upright."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


class _Bounded(io.BufferedReader):
    """A file that makes room for no more bytes than it has: decoders ask for as many as damaged headers announce."""

    def read(self, size: int | None = -1, /) -> bytes:
        rest = max(0, os.fstat(self.fileno()).st_size - self.tell())
        return super().read(rest if size is None or size < 0 else min(size, rest))


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    if path.suffix.lower() in HEIF and not heif_is_read():
        raise InputError(
            f"{path}: expected the package pillow-heif, which reads this photo, found none: pip install "
            "'clsplat[heic]', or convert the photos to JPEG"
        )
    try:
        with _Bounded(io.FileIO(path)) as file, Image.open(file) as image:
            yield image
    except InputError:
        raise
    except Exception as error:  # damaged files make decoders raise anything: OSError, SyntaxError, zlib.error ...
        raise InputError(
            f"{path}: expected an image that can be decoded, found {error or type(error).__name__}"
        ) from error


def photo_size(path: Path) -> tuple[int, int]:
    """Width and height of the pixels as stored; reads the file's header only.

    Raises
    ------
    InputError
        If the file is no image.
    """
    with _opened(path) as image:
        return image.size


def orientation(path: Path) -> int:
    """EXIF orientation, 1 to 8; 1 where the file names none or an unknown one. A PNG is decoded for it.

    Raises
    ------
    InputError
        If the file is no image.
    """
    with _opened(path) as image:
        tag = image.getexif().get(ExifTags.Base.Orientation, 1)
        return int(tag) if tag in range(1, 9) else 1


def is_plain(path: Path) -> bool:
    """Whether every reader sees these pixels alike: an upright JPEG or PNG, 8-bit RGB or grey.

    Raises
    ------
    InputError
        If the file is no image.
    """
    with _opened(path) as image:
        # An MPO is a JPEG with further pictures behind the first, as some phones and 3D cameras write it.
        plain = image.format in ("JPEG", "MPO", "PNG") and image.mode in ("RGB", "L")
        transparent = "transparency" in image.info
    return plain and not transparent and orientation(path) == 1


def is_transparent(path: Path) -> bool:
    """Whether a photo has an alpha channel or a transparent colour.

    Raises
    ------
    InputError
        If the file is no image.
    """
    with _opened(path) as image:
        return image.mode in TRANSPARENT or "transparency" in image.info


def write_upright_png(source: Path, target: Path) -> None:
    """Write the photo `source` as an upright 8-bit RGB PNG, whatever the ending of `target`.

    EXIF data other than the orientation go along: structure from motion finds the focal length there.

    Raises
    ------
    InputError
        If `source` cannot be decoded.
    """
    with _opened(source) as image:
        upright = ImageOps.exif_transpose(image)
        exif = upright.getexif()
        rgb = Image.fromarray(_rgb(upright, (0.0, 0.0, 0.0), source))
    target.parent.mkdir(parents=True, exist_ok=True)
    rgb.save(target, format="PNG", exif=exif, compress_level=1)  # read once, then deleted: speed before size


def read_photo(path: Path, background: tuple[float, float, float], upright: bool) -> NDArray[np.uint8]:
    """Decode a photo.

    Parameters
    ----------
    path : Path
        Any kind of file in `SUFFIXES`: grey, palette, CMYK, transparent, 16 bits (of which the upper 8 count).
    background : (3,) float
        RGB in [0, 1] behind transparent pixels.
    upright : bool
        Turn the pixels as the EXIF orientation says; otherwise they stay as they are stored.

    Returns
    -------
    (H, W, 3) uint8
        RGB.

    Raises
    ------
    InputError
        If the file is damaged, no image, or has floating-point or 32-bit pixels; the message names it.
    """
    with _opened(path) as image:
        return _rgb(ImageOps.exif_transpose(image) if upright else image, background, path)


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Decode a mask: (H, W) bool, True where the image is white.

    Raises
    ------
    InputError
        If the file cannot be decoded, or has no white but greys: a mask of 0 and 1 would hide everything.
    """
    with _opened(path) as image:
        values = _rgb(image, (0.0, 0.0, 0.0), path).max(axis=2)
    mask: NDArray[np.bool_] = values >= 128
    if values.any() and not mask.any():
        raise InputError(f"{path}: expected a mask of black (0) and white (255), found values up to {values.max()}")
    return mask


def _rgb(image: Image.Image, background: tuple[float, float, float], path: Path) -> NDArray[np.uint8]:
    if image.mode.startswith("I") or image.mode == "F":  # one channel of 16 or 32 bits
        grey = np.asarray(image)
        if image.mode == "F" or grey.min() < 0 or grey.max() > 0xFFFF:
            raise InputError(
                f"{path}: expected 8 or 16 bits per channel, found 32 (mode {image.mode}); convert the photo"
            )
        return np.repeat((grey.astype(np.uint16) >> 8).astype(np.uint8)[..., None], 3, axis=2)
    if image.mode in TRANSPARENT or "transparency" in image.info:
        rgba = np.asarray(image.convert("RGBA"), dtype=np.float32)
        alpha = rgba[..., 3:] / 255
        blended = rgba[..., :3] * alpha + 255 * np.asarray(background, dtype=np.float32) * (1 - alpha)
        return np.rint(blended).astype(np.uint8)
    return np.array(image if image.mode == "RGB" else image.convert("RGB"))


def photo_sharpness(path: Path) -> float:
    """`sharpness` of a photo at `SHARPNESS_EDGE`.

    Raises
    ------
    InputError
        If the file cannot be decoded.
    """
    with _opened(path) as image:
        image.draft("L", (SHARPNESS_EDGE, SHARPNESS_EDGE))  # JPEG: decodes a smaller copy, in a fraction of the time
        grey = Image.fromarray(_rgb(image, (0.0, 0.0, 0.0), path)).convert("L")
    grey.thumbnail((SHARPNESS_EDGE, SHARPNESS_EDGE))
    return sharpness(np.asarray(grey))


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian of an image (H, W): less for a blurred photo of the same (Pech-Pacheco et al. 2000,
    doi:10.1109/ICPR.2000.903548)."""
    g = grey.astype(np.float32)
    laplacian = g[1:-1, :-2] + g[1:-1, 2:] + g[:-2, 1:-1] + g[2:, 1:-1] - 4 * g[1:-1, 1:-1]
    return float(laplacian.var(dtype=np.float64)) if laplacian.size else 0.0
