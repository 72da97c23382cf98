"""Images of a SOG scene that is written: one pixel per Gaussian, compressed as lossless WebP."""

import io
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

METHOD = 4
"""Effort of the WebP encoder, 0 to 6. Measurement: docs/formats.md."""

OUT_OF_MEMORY = "encoding error 1"
"""Message of Pillow's ValueError where the WebP encoder finds no memory: VP8_ENC_ERROR_OUT_OF_MEMORY of libwebp."""


class Images:
    """Images to write, (H, W, 4) by name, with a pixel per Gaussian in almost square images."""

    def __init__(self, count: int) -> None:
        self.files: dict[str, Array] = {}
        self.count = count
        self.width = 4 * math.ceil(math.sqrt(count) / 4)
        self.height = 4 * math.ceil(count / self.width / 4)

    def add(self, name: str, *columns: Array) -> str:
        """Add an image with the columns (N, k) as its channels; return the name of its file."""
        pixels = np.full((self.height * self.width, 4), 255, np.uint8)
        for channel, column in enumerate(np.concatenate(columns, axis=1).T):
            pixels[: self.count, channel] = column
        self.files[f"{name}.webp"] = pixels.reshape(self.height, self.width, 4)
        return f"{name}.webp"


def webp(pixels: Array) -> bytes:
    """Compress an image (H, W, 4)."""
    from PIL import Image

    file = io.BytesIO()
    # Without exact, the encoder drops colours where alpha is 0; here alpha is data like the other channels.
    try:
        Image.fromarray(pixels).save(file, format="WEBP", lossless=True, exact=True, method=METHOD)
    except ValueError as error:
        if str(error) == OUT_OF_MEMORY:
            raise MemoryError("an image cannot be compressed") from error
        raise
    return file.getvalue()
