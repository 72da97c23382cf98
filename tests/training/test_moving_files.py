"""Files of what moves in photos."""

from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.training.moving_files import MOVING, load_masks, packed, save_masks, unpacked


def test_masks_in_files(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    masks = {"a/ä.png": rng.random((7, 5)) < 0.5, "b": rng.random((4, 6)) < 0.5}
    save_masks(tmp_path, masks)
    found = load_masks(tmp_path)
    assert list(found) == list(masks) and all((found[name] == masks[name]).all() for name in masks)
    arrays = packed(masks)
    for broken in (
        arrays | {"moving.1": arrays["moving.1"][:-1]},
        {k: v for k, v in arrays.items() if k != "moving.0"},
        arrays | {"moving": "{"},
        arrays | {"moving": '{"a": [1]}'},
        arrays | {"moving.0": arrays["moving.0"].astype(np.float32)},
    ):
        with pytest.raises((KeyError, TypeError, ValueError)):
            unpacked({name: np.asarray(array) for name, array in broken.items()})
    (tmp_path / MOVING).write_bytes(b"PK")
    with pytest.raises(InputError, match="expected masks of clsplat, found a damaged file"):
        load_masks(tmp_path)
    save_masks(tmp_path, {})
    assert load_masks(tmp_path) == {} and not list(tmp_path.iterdir())
