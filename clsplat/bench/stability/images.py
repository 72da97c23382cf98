"""Experiment: image files of many kinds."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from clsplat.bench.stability.experiment import Experiment, Figure, Found
from clsplat.dataset.photos import read_photo
from clsplat.device import Device
from clsplat.errors import InputError

GREY = np.linspace(0, 255, 12 * 16).reshape(12, 16)
RGB = np.stack([GREY, GREY[::-1], GREY[:, ::-1]], axis=2).astype(np.uint8)


def write_kinds(folder: Path) -> dict[str, Any]:
    """Write an image file of each kind. Returns by name its upright RGB on black, or None if it must be refused."""
    image = Image.fromarray(RGB)
    turned = Image.Exif()
    turned[0x0112] = 3
    alpha = np.full((12, 16), 128, np.uint8)
    half = np.rint(RGB * np.float32(128 / 255)).astype(np.uint8)
    grey = RGB[..., :1].repeat(3, axis=2)
    image.save(folder / "rgb.png")
    Image.fromarray(np.dstack([RGB, alpha])).save(folder / "transparent.png")
    Image.fromarray(RGB[..., 0]).save(folder / "grey.png")
    Image.fromarray(np.dstack([RGB[..., 0], alpha]), "LA").save(folder / "grey transparent.png")
    Image.fromarray(RGB[..., 0].astype(np.uint16) * 256 + 7).save(folder / "16 bits.png")
    image.quantize(256).save(folder / "palette.png")
    image.convert("CMYK").save(folder / "cmyk.tif")
    image.save(folder / "turned.tif", exif=turned)
    Image.fromarray(RGB[..., 0].astype(np.float32)).save(folder / "float.tif")
    (folder / "cut.png").write_bytes((folder / "rgb.png").read_bytes()[:-40])
    (folder / "text.png").write_text("no image")
    palette = np.asarray(image.quantize(256).convert("RGB"))
    return {
        **{"rgb.png": RGB, "transparent.png": half, "grey.png": grey},
        **{"grey transparent.png": half[..., :1].repeat(3, axis=2)},
        **{"16 bits.png": grey, "palette.png": palette, "cmyk.tif": RGB, "turned.tif": RGB[::-1, ::-1]},
        **{"float.tif": None, "cut.png": None, "text.png": None},
    }


def _right(path: Path, expected: Any, read: Any) -> bool:
    try:
        found = read(path)
    except InputError as error:
        return expected is None and path.name in str(error)
    except Exception:  # a message of the decoder names neither the file nor a remedy
        return False
    if expected is None or found.shape != expected.shape:
        return False
    return bool(np.abs(found - expected.astype(float)).max() <= 1)


def right_kinds(read: Any) -> tuple[int, int]:
    """Number of kinds that a reader reads correctly to one level, or refuses by name if it must; and their total."""
    with TemporaryDirectory() as folder:
        kinds = write_kinds(Path(folder))
        return sum(_right(Path(folder) / name, expected, read) for name, expected in kinds.items()), len(kinds)


def plain(path: Path) -> Any:
    """Read an image with one line of Pillow."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def ours(path: Path) -> Any:
    """Read an image with clsplat."""
    return read_photo(path, (0.0, 0.0, 0.0), upright=True)


def _kinds(device: Device) -> Found:
    (without, total), (remedied, _) = right_kinds(plain), right_kinds(ours)
    return Found([Figure("Pillow's convert", without, f"of {total}"), Figure("clsplat", remedied, f"of {total}")])


KINDS = Experiment(
    failure="images of mixed size, orientation, EXIF rotation, 16-bit, grey, RGBA, CMYK, corrupt",
    source="issues of every implementation",
    remedy="each kind has a rule, and all others are refused, naming the file",
    test="tests/stability/test_images.py::test_each_kind_is_read_correctly_or_refused_by_name",
    measure=_kinds,
    figure="kinds of files that are read correctly, or refused by name if they must be",
)
