"""A picture of what moves in training photos, which training has left out."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.scene import View

MOST = 24
"""Most photos that are drawn, those with the largest parts that move."""

COLUMNS = 4

CELL = 200
"""Least width of a photo in the picture, px, for its name; smaller ones are enlarged by a whole factor."""

COLOR = (255, 0, 255)
"""Colour of what moves, which is rare in photos."""


def moving_sheet(path: Path, views: list[View], found: Mapping[str, NDArray[np.bool_]]) -> None:
    """Write a PNG of the photos in which most moves, with that in one colour.

    Parameters
    ----------
    path : Path
    views : list of View
        The training photos.
    found : mapping of str to (H, W) bool
        Pixels that move, in reduced photos, by name; at least one photo.
    """
    from PIL import Image, ImageDraw, ImageFont

    chosen = sorted((v for v in views if v.name in found), key=lambda v: -found[v.name].mean())[:MOST]
    masks = [found[view.name] for view in chosen]
    factor = max(1, -(-CELL // max(mask.shape[1] for mask in masks)))
    width, height = (factor * max(mask.shape[axis] for mask in masks) for axis in (1, 0))
    gap, margin = 8, 24
    rows = -(-len(chosen) // COLUMNS)
    columns = min(COLUMNS, len(chosen))
    sheet = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + margin) + gap), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    for k, (view, moving) in enumerate(zip(chosen, masks, strict=True)):
        photo = np.array(Image.fromarray(view.image).resize(moving.shape[::-1], Image.Resampling.BOX))
        photo[moving] = COLOR
        photo = photo.repeat(factor, axis=0).repeat(factor, axis=1)
        left, top = gap + k % columns * (width + gap), k // columns * (height + margin)
        draw.text((left, top + margin / 2), f"{view.name}, {moving.mean():.0%}", fill="black", font=font, anchor="lm")
        sheet.paste(Image.fromarray(photo), (left, top + margin))
    with replacing(path) as file:
        sheet.save(file, format="PNG")
