"""The picture of what moves in training photos."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from small_run import cameras

from clsplat.scene import View
from clsplat.show.moving_sheet import COLOR, COLUMNS, MOST, moving_sheet


def test_the_sheet_shows_the_photos_in_which_most_moves(tmp_path: Path) -> None:
    camera = cameras(1)[0]
    views = [
        View(f"{k}.png", camera, np.full((camera.height, camera.width, 3), 8 * k, np.uint8)) for k in range(MOST + 3)
    ]
    found = {view.name: np.zeros((16, 200), bool) for view in views[1:]}
    for k, mask in enumerate(found.values()):
        mask[: k % 13 + 1] = True
    moving_sheet(tmp_path / "moving.png", views, found)
    sheet = np.asarray(Image.open(tmp_path / "moving.png"))
    assert (sheet == COLOR).all(axis=2).sum() == 200 * sum(sorted(k % 13 + 1 for k in range(MOST + 2))[2:])
    assert sheet.shape[1] == COLUMNS * 208 + 8 and sheet.shape[0] == MOST // COLUMNS * 40 + 8


def test_a_sheet_of_photos_of_two_sizes(tmp_path: Path) -> None:
    camera = cameras(1)[0]
    tall = replace(camera, width=camera.height, height=camera.width)
    views = [View("wide", camera, np.zeros((camera.height, camera.width, 3), np.uint8))]
    views.append(View("tall", tall, np.full((tall.height, tall.width, 3), 90, np.uint8)))
    found = {"wide": np.ones((16, 20), bool), "tall": np.zeros((20, 16), bool)}
    found["tall"][:2] = True
    moving_sheet(tmp_path / "moving.png", views, found)
    sheet = np.asarray(Image.open(tmp_path / "moving.png"))
    assert (sheet == COLOR).all(axis=2).sum() == 100 * (16 * 20 + 2 * 16), "ten times as large"
    assert (sheet == 90).all(axis=2).sum() >= 100 * 18 * 16, "and some pixels of letters"
    assert sheet.shape[1] == 2 * 208 + 8
