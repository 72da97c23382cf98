"""Files of what moves in training photos: a part of a checkpoint, and a file of its own at the end of a run."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.errors import InputError
from clsplat.training.moving import Masks

MOVING = "moving.npz"
"""File name of the masks in the folder of a run; there is none if nothing moved."""


def packed(found: Masks) -> dict[str, Any]:
    """Arrays of an .npz file that hold masks, a bit per pixel."""
    arrays: dict[str, Any] = {"moving": json.dumps({name: mask.shape for name, mask in found.items()})}
    return arrays | {f"moving.{k}": np.packbits(mask) for k, mask in enumerate(found.values())}


def unpacked(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.bool_]]:
    """The masks in the arrays of a file.

    Raises
    ------
    KeyError, TypeError or ValueError
        If the arrays are not those of `packed`.
    """
    found = {}
    for k, (name, (height, width)) in enumerate(json.loads(str(arrays["moving"])).items()):
        bits = arrays[f"moving.{k}"]
        if bits.dtype != np.uint8 or bits.shape != (-(-height * width // 8),):
            raise ValueError(f"moving.{k} of type {bits.dtype} and shape {bits.shape}")
        found[name] = np.unpackbits(bits, count=height * width).astype(bool).reshape(height, width)
    return found


def save_masks(out: Path, found: Masks) -> None:
    """Write masks to the folder of a run, whole or not at all; without any, remove those of an earlier run."""
    if not found:
        (out / MOVING).unlink(missing_ok=True)
        return
    with replacing(out / MOVING) as file:
        np.savez(file, **packed(found))


def load_masks(out: Path) -> dict[str, NDArray[np.bool_]]:
    """Read the masks in the folder of a run; there are none if nothing moved.

    Raises
    ------
    InputError
        If their file is damaged.
    """
    return read_masks(out / MOVING) if (out / MOVING).exists() else {}


def read_masks(path: Path) -> dict[str, NDArray[np.bool_]]:
    """Read a file of masks.

    Raises
    ------
    InputError
        If it cannot be read or is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return unpacked(arrays)
    except (AttributeError, EOFError, KeyError, OSError, TypeError, ValueError, BadZipFile) as error:
        raise InputError(f"{path}: expected masks of clsplat, found a damaged file: {error!r}") from error
