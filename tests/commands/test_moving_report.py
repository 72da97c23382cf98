"""What `clsplat train` says and draws of what it left out because it moves."""

from pathlib import Path

import numpy as np
import pytest
from small_run import known_scene

from clsplat.commands.train import say_moving
from clsplat.training.moving_files import save_masks


def test_what_moves_is_said_drawn_and_left_out_of_what_follows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = known_scene()
    assert say_moving(scene, tmp_path) is scene and not capsys.readouterr().err and not list(tmp_path.iterdir())
    moves = np.zeros(scene.train[0].image.shape[:2], bool)
    moves[5:9, 10:20] = True
    save_masks(tmp_path, {"3.png": moves, "7.png": moves})
    left = say_moving(scene, tmp_path)
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith("moving: 2 of 12 training photos show what the others contradict, such as people who walk")
    assert f"{tmp_path / 'moving.png'} shows where" in said and (tmp_path / "moving.png").exists()
    for view in left.train:
        assert (view.counts == (~moves if view.name in ("3.png", "7.png") else True)).all()
