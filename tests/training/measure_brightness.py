"""Photos at random brightness: what evening them out, and learning exposures, make up for.

python tests/training/measure_brightness.py DATA OUT
clsplat train OUT -o RUN --downscale 4    # and with --exposure, and with --no-even-brightness
"""

import sys
from pathlib import Path

import numpy as np
from measure_people import reduced
from PIL import Image

from clsplat.config import DataConfig

DOWNSCALE = 4
"""Factor by which the photos' edges are divided."""

SPREAD = 0.2
"""Standard deviation of the logarithm of a photo's brightness."""


def main(data: Path, out: Path) -> None:
    """Write reduced training photos of a COLMAP dataset times random factors, and held-out ones as they are."""
    copies = out / f"images_{DOWNSCALE}"
    copies.mkdir(parents=True)
    for folder in ("images", "sparse"):
        (out / folder).symlink_to((data / folder).resolve())
    rng = np.random.default_rng(7)
    for number, path in enumerate(sorted((data / "images").iterdir())):
        factor = np.exp(SPREAD * rng.normal())
        if number % DataConfig().test_every == 0:
            factor = 1.0
        image = np.rint(np.clip(factor * reduced(path, DOWNSCALE), 0, 255)).astype(np.uint8)
        Image.fromarray(image).save(copies / path.name, format="PNG")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
