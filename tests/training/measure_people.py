"""Photos in which people walk by: what leaving them out of a training makes up for.

python tests/training/measure_people.py DATA TEXTURES OUT 4
clsplat train OUT -o RUN --downscale 4    # and with --no-mask-moving, and with --masks true

In half of the training photos are one to three silhouettes of people, at random places, with the colours of parts of
other photos. Held-out photos stay as they are.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from clsplat.config import DataConfig

SHARE = 0.5
"""Fraction of the training photos with people."""

FINE = 4
"""Factor by which a silhouette is drawn larger, for a smooth edge."""


def silhouette(width: int, height: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Coverage (H, W) of a person, 0 to 1: head, body and two legs."""
    size = np.array([width, height]) * FINE
    image = Image.new("L", tuple(size.tolist()))
    draw = ImageDraw.Draw(image)
    for box in ((0.32, 0, 0.68, 0.17), (0.12, 0.14, 0.88, 0.6)):
        draw.ellipse(tuple((np.array(box) * np.tile(size, 2)).tolist()), fill=255)
    step = rng.uniform(0, 0.15)
    for hip, knee, foot in ((0.2, 0.5, 0.2 - step), (0.5, 0.8, 0.55 + step)):
        corners = [(hip, 0.45), (knee, 0.45), (foot + 0.25, 1), (foot, 1)]
        draw.polygon([tuple((np.array(corner) * size).tolist()) for corner in corners], fill=255)
    return np.asarray(image.resize((width, height), Image.Resampling.BOX), float) / 255


def reduced(path: Path, factor: int) -> NDArray[np.float64]:
    """A photo (H, W, 3), 0 to 255, its edges divided by a factor."""
    with Image.open(path) as photo:
        pixels = np.asarray(photo.convert("RGB"), float)
    height, width = (edge // factor for edge in pixels.shape[:2])
    whole = pixels[: height * factor, : width * factor]
    return whole.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))


def with_person(
    image: NDArray[np.float64],
    covered: NDArray[np.float64],
    textures: list[Path],
    factor: int,
    rng: np.random.Generator,
) -> None:
    """Put a person into a reduced photo, and its coverage into `covered`, both in place."""
    h, w = covered.shape
    height = int(h * rng.uniform(0.2, 0.5))
    width = int(height * rng.uniform(0.35, 0.55))
    y, x = int(rng.uniform(0.35 * h, 0.95 * h - height * 0.6)), int(rng.uniform(-width / 2, w - width / 2))
    with Image.open(textures[rng.integers(len(textures))]) as photo:
        texture = photo.convert("RGB")
    left = int(rng.integers(0, max(1, texture.width - width * factor)))
    top = int(rng.integers(0, max(1, texture.height - height * factor)))
    box = left, top, left + width * factor, top + height * factor
    clothes = np.asarray(texture.crop(box).resize((width, height), Image.Resampling.BOX), float)
    clothes = np.clip(clothes * rng.uniform(0.5, 1.1, 3), 0, 255)
    person = silhouette(width, height, rng)
    rows, columns = slice(max(y, 0), min(y + height, h)), slice(max(x, 0), min(x + width, w))
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return
    own = slice(rows.start - y, rows.stop - y), slice(columns.start - x, columns.stop - x)
    share = person[own][:, :, None]
    image[rows, columns] = image[rows, columns] * (1 - share) + clothes[own] * share
    covered[rows, columns] = np.maximum(covered[rows, columns], person[own])


def main(data: Path, textures: Path, out: Path, factor: int) -> None:
    """Write reduced photos of a COLMAP dataset with people, and masks of these in the folder `true`."""
    copies, masks = out / ("images" if factor == 1 else f"images_{factor}"), out / "true"
    for folder in copies, masks:
        folder.mkdir(parents=True)
    for name in ("images", "sparse"):
        if not (out / name).exists():
            (out / name).symlink_to((data / name).resolve())
    others = sorted((textures / "images").iterdir())
    rng = np.random.default_rng(11)
    for number, path in enumerate(sorted((data / "images").iterdir())):
        image = reduced(path, factor)
        covered = np.zeros(image.shape[:2])
        if number % DataConfig().test_every and rng.random() < SHARE:
            for _ in range(rng.integers(1, 4)):
                with_person(image, covered, others, factor, rng)
        Image.fromarray(np.rint(image).astype(np.uint8)).save(copies / path.name, format="PNG")
        Image.fromarray(np.where(covered > 0.05, 0, 255).astype(np.uint8)).save(masks / f"{path.stem}.png")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]), int(sys.argv[4]))
