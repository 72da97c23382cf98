"""Photo files: list them, read their size and orientation, decode them to 8-bit RGB."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps
from PIL.TiffImagePlugin import TiffImageFile

from clsplat.errors import InputError

HEIF = (".heic", ".heif")
"""Suffixes, in lower case, of the photos that need pillow-heif."""

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", *HEIF)
"""Suffixes, in lower case, of the files that count as photos."""

SHARPNESS_EDGE = 640
"""Longer edge, in pixels, to which photos are reduced before their sharpness is measured. Motion blur is still
visible at this size; noise is averaged out."""

FRAMES = "clsplat_frames.json"
"""Name of the file that marks a folder of photos as frames of a video, in the order of their names. It records the
video and how the frames were chosen."""

TRANSPARENT = ("RGBA", "RGBa", "LA", "La", "PA")
"""Pillow image modes with an alpha channel."""

TURNED_BACK = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
"""How upright pixels become those that are stored, by the EXIF orientation."""


def photo_folder(path: Path) -> Path:
    """Return the folder with the photos of a dataset: its folder ``images`` if it exists, otherwise `path` itself."""
    return path / "images" if (path / "images").is_dir() else path


def list_photos(path: Path) -> list[str]:
    """List the photos of the dataset `path`: sorted names, relative to `photo_folder`, with forward slashes.

    Sub-folders are searched inside ``images`` only. Elsewhere they may hold masks, smaller copies or results.
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
    """Register pillow-heif with Pillow and return whether it is installed.

    pillow-heif applies the orientation itself: HEIF photos are upright when opened.
    """
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


class _Bounded(io.BufferedReader):
    """A file whose `read` allocates no more bytes than the file has.

    Decoders request as many bytes as the header declares, which in a damaged file may be any number.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        rest = max(0, os.fstat(self.fileno()).st_size - self.tell())
        return super().read(rest if size is None or size < 0 else min(size, rest))


@contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """Open a photo with Pillow; any error while it is open becomes an InputError that names the photo."""
    if path.suffix.lower() in HEIF and not heif_is_read():
        raise InputError(
            f"cannot read {path}: the package pillow-heif is not installed; pip install 'clsplat[heic]', or convert "
            "the photos to JPEG"
        )
    try:
        with _Bounded(io.FileIO(path)) as file, Image.open(file) as image:
            yield image
    except InputError:
        raise
    except Image.DecompressionBombError as error:
        most = 2 * (Image.MAX_IMAGE_PIXELS or 0) / 1e6  # Pillow refuses twice the pixels of which it warns
        raise InputError(
            f"cannot read {path}: it has more than {most:.0f} million pixels, the most that are decoded; write "
            "smaller copies of the photos"
        ) from error
    # Decoders raise many kinds of exceptions on damaged files: OSError, SyntaxError, zlib.error ...
    except Exception as error:
        raise InputError(f"cannot read {path} as an image: {error or type(error).__name__}") from error


def photo_size(path: Path) -> tuple[int, int]:
    """Read the width and height of a photo as stored, in pixels, from the file's header.

    Raises
    ------
    InputError
        If the file is not an image.
    """
    with opened(path) as image:
        if isinstance(image, TiffImageFile):  # Pillow 11 declares the turned size
            return image.tag_v2[ExifTags.Base.ImageWidth], image.tag_v2[ExifTags.Base.ImageLength]
        return image.size


def as_stored(image: Image.Image) -> Image.Image:
    """Load an opened image with its pixels as stored. Pillow itself turns those of a TIFF by its orientation."""
    tag = image.getexif().get(ExifTags.Base.Orientation, 1) if isinstance(image, TiffImageFile) else 1
    image.load()
    return image.transpose(TURNED_BACK[tag]) if tag in TURNED_BACK else image


def loaded(image: Image.Image, upright: bool) -> Image.Image:
    """Load an opened image, turned by its EXIF orientation or, unless `upright` is set, with its pixels as stored."""
    return ImageOps.exif_transpose(image) if upright else as_stored(image)


def orientation(path: Path) -> int:
    """Read the EXIF orientation, 1 to 8; 1 if it is missing or unknown. A PNG is decoded for this.

    Raises
    ------
    InputError
        If the file is not an image.
    """
    with opened(path) as image:
        tag = image.getexif().get(ExifTags.Base.Orientation, 1)
        return int(tag) if tag in range(1, 9) else 1


def gps_position(path: Path) -> tuple[float, float] | None:
    """Read latitude and longitude, degrees, from the EXIF data; None if they are missing or impossible.

    Cameras without reception write 0, 0.

    Raises
    ------
    InputError
        If the file is not an image.
    """
    with opened(path) as image:
        gps = image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
        try:
            latitude, longitude = (
                float(np.dot(np.array(gps[tag], dtype=float), (1, 1 / 60, 1 / 3600)))
                for tag in (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLongitude)
            )
            south, west = gps[ExifTags.GPS.GPSLatitudeRef] == "S", gps[ExifTags.GPS.GPSLongitudeRef] == "W"
        except (ArithmeticError, KeyError, TypeError, ValueError):
            return None
    if not (0 <= latitude <= 90 and 0 <= longitude <= 180) or latitude == longitude == 0:
        return None
    return -latitude if south else latitude, -longitude if west else longitude


def is_plain(path: Path) -> bool:
    """Whether every program decodes the photo to the same pixels: an upright JPEG or PNG, 8-bit RGB or grey.

    Raises
    ------
    InputError
        If the file is not an image.
    """
    with opened(path) as image:
        # An MPO is a JPEG followed by further pictures, as some phones and 3D cameras write it.
        plain = image.format in ("JPEG", "MPO", "PNG") and image.mode in ("RGB", "L")
        transparent = "transparency" in image.info
    return plain and not transparent and orientation(path) == 1


def is_transparent(path: Path) -> bool:
    """Whether a photo has an alpha channel or a transparent colour.

    Raises
    ------
    InputError
        If the file is not an image.
    """
    with opened(path) as image:
        return image.mode in TRANSPARENT or "transparency" in image.info


def write_upright_png(source: Path, target: Path) -> None:
    """Write the photo `source` as an upright 8-bit RGB PNG, whatever the suffix of `target`.

    EXIF data of the camera and its place are copied: structure from motion reads the focal length from them.

    Raises
    ------
    InputError
        If `source` cannot be decoded.
    """
    with opened(source) as image:
        rgb = Image.fromarray(_rgb(ImageOps.exif_transpose(image), (0.0, 0.0, 0.0), source))
        try:
            exif = _exif_of_camera(image)
        except Exception:  # damaged tags, which Pillow reads but cannot write: the pixels are those of the photo
            exif = b""
    target.parent.mkdir(parents=True, exist_ok=True)
    rgb.save(target, format="PNG", exif=exif, compress_level=1)  # a temporary file: fast rather than small


def _exif_of_camera(image: Image.Image) -> bytes:
    """EXIF data of the camera and its place. The other tags of a TIFF describe its own pixels."""
    found, kept = image.getexif(), Image.Exif()
    for tag in (ExifTags.Base.Make, ExifTags.Base.Model):
        if tag in found:
            kept[tag] = found[tag]
    for ifd in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
        if tags := found.get_ifd(ifd):
            kept[ifd] = tags
    return kept.tobytes()


def read_photo(path: Path, background: tuple[float, float, float], upright: bool) -> NDArray[np.uint8]:
    """Decode a photo.

    Parameters
    ----------
    path : Path
        File of any kind in `SUFFIXES`: grey, palette, CMYK, transparent, 16 bits (the upper 8 are used).
    background : (3,) float
        RGB in [0, 1] behind transparent pixels.
    upright : bool
        Whether to turn the pixels by the EXIF orientation; otherwise they are returned as stored.

    Returns
    -------
    (H, W, 3) uint8
        RGB.

    Raises
    ------
    InputError
        If the file is damaged, is not an image, has floating-point or 32-bit pixels, or has 16 bits of which the
        upper 8 are unused; the message names it.
    """
    with opened(path) as image:
        return _rgb(loaded(image, upright), background, path)


def read_mask(path: Path, upright: bool = False) -> NDArray[np.bool_]:
    """Decode a mask: (H, W) bool, True where the image is white; `upright` as for its photo in `read_photo`.

    Raises
    ------
    InputError
        If the file cannot be decoded, or has grey pixels but no white ones: a mask of 0 and 1 would hide everything.
    """
    with opened(path) as image:
        values = _rgb(loaded(image, upright), (0.0, 0.0, 0.0), path).max(axis=2)
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
        if 0 < grey.max() < 256:  # their upper 8 bits are black
            raise InputError(
                f"{path}: expected values up to 65535 in 16 bits, found none above {grey.max()}; convert it to 8 bits"
            )
        shade = np.repeat((grey.astype(np.uint16) >> 8).astype(np.float32)[..., None], 3, axis=2)
        return _over(shade, (grey != image.info.get("transparency", -1))[..., None], background)
    colour = image.info.get("transparency")
    if isinstance(colour, tuple) and max(colour) > 255:  # Pillow has reduced the pixels to 8 bits, but not the colour
        raise InputError(
            f"{path}: expected 8 bits per channel beside a transparent colour, found 16; convert the photo"
        )
    if image.mode in TRANSPARENT or "transparency" in image.info:
        rgba = np.asarray(image.convert("RGBA"), dtype=np.float32)
        return _over(rgba[..., :3], rgba[..., 3:] / 255, background)
    return np.array(image if image.mode == "RGB" else image.convert("RGB"))


def _over(rgb: NDArray[Any], alpha: NDArray[Any], background: tuple[float, float, float]) -> NDArray[np.uint8]:
    """Blend RGB (H, W, 3) of 0 to 255 with a background by alpha (H, W, 1) of 0 to 1."""
    blended = rgb * alpha + 255 * np.asarray(background, dtype=np.float32) * (1 - alpha)
    return np.rint(blended).astype(np.uint8)


def photo_sharpness(path: Path) -> float:
    """Measure the `sharpness` of a photo reduced to `SHARPNESS_EDGE`.

    Raises
    ------
    InputError
        If the file cannot be decoded.
    """
    with opened(path) as image:
        image.draft("L", (SHARPNESS_EDGE, SHARPNESS_EDGE))  # decodes a JPEG at a smaller size, which is faster
        grey = Image.fromarray(_rgb(image, (0.0, 0.0, 0.0), path)).convert("L")
    grey.thumbnail((SHARPNESS_EDGE, SHARPNESS_EDGE))
    return sharpness(np.asarray(grey))


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Measure the sharpness of a grey image (H, W): the variance of its Laplacian, which blur lowers.

    Pech-Pacheco et al. 2000, doi:10.1109/ICPR.2000.903548.
    """
    g = grey.astype(np.float32)
    laplacian = g[1:-1, :-2] + g[1:-1, 2:] + g[:-2, 1:-1] + g[2:, 1:-1] - 4 * g[1:-1, 1:-1]
    return float(laplacian.var(dtype=np.float64)) if laplacian.size else 0.0
