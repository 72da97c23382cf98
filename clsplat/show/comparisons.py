"""Pictures that compare renders with photos: single ones, their differences, and both side by side."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.errors import InputError
from clsplat.metrics import to_uint8

Array = NDArray[Any]

DIFFERENCE_MAX = 0.2
"""Mean absolute difference of the channels at which the difference picture saturates, as a fraction of full
scale. Errors appear five times as large as they are."""

COLOR_MAP = "magma"
"""Colour map of differences. It is perceptually uniform: equal steps of the difference look equally large."""


def save_png(path: Path, image: Array) -> None:
    """Write an image, (H, W, 3) uint8 or float in [0, 1], as PNG."""
    from PIL import Image

    with replacing(path) as file:
        Image.fromarray(to_uint8(image)).save(file, format="PNG")


def save_difference(path: Path, image: Array, truth: Array, mask: NDArray[np.bool_] | None = None) -> None:
    """Write the mean absolute difference of the channels as a PNG in `COLOR_MAP`, saturated at `DIFFERENCE_MAX`.

    Parameters
    ----------
    path : Path
    image, truth : (H, W, 3) uint8 or float in [0, 1]
    mask : (H, W) bool, optional
        True where pixels count. Other pixels are drawn as equal.
    """
    from PIL import Image

    error = np.abs(to_uint8(image).astype(np.float64) - to_uint8(truth)).mean(axis=2)
    level = np.rint(np.minimum(error / DIFFERENCE_MAX, 255)).astype(np.uint8)
    picture = Image.fromarray(level if mask is None else level * mask)
    picture.putpalette(palette(256).tobytes())
    with replacing(path) as file:
        picture.save(file, format="PNG")


def side_by_side(path: Path, pairs: list[tuple[Array, Array]]) -> None:
    """Write a PNG with one row per pair: the photo on the left, its render on the right.

    Parameters
    ----------
    path : Path
    pairs : list of ((H, W, 3), (H, W, 3))
        Photo and render, uint8 or float in [0, 1]. Rows may differ in size.

    Raises
    ------
    InputError
        If there is no pair, or the file cannot be written.
    """
    from PIL import Image, ImageDraw, ImageFont

    if not pairs:
        raise InputError("pairs: expected at least one photo and its render, found none")
    gap, margin = 8, 28
    rows = [[to_uint8(image) for image in pair] for pair in pairs]
    column = max(image.shape[1] for row in rows for image in row)
    height = margin + sum(max(image.shape[0] for image in row) + gap for row in rows)
    sheet = Image.new("RGB", (2 * column + 3 * gap, height), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(16)
    for k, label in enumerate(("photo", "render")):
        draw.text((gap + k * (column + gap), margin / 2), label, fill="black", font=font, anchor="lm")
    top = margin
    for row in rows:
        for k, image in enumerate(row):
            sheet.paste(Image.fromarray(image), (gap + k * (column + gap), top))
        top += max(image.shape[0] for image in row) + gap
    with replacing(path) as file:
        sheet.save(file, format="PNG")


def palette(colors: int) -> NDArray[np.uint8]:
    """`COLOR_MAP` in equal steps, (colors, 3) uint8."""
    from matplotlib import colormaps

    return colormaps[COLOR_MAP](np.linspace(0, 1, colors), bytes=True)[:, :3]
