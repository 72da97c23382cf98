"""What `clsplat train` says and draws of what it left out because it moves."""

from pathlib import Path

import numpy as np
import pytest
from small_run import known_scene

from clsplat.commands.run_folders import as_trained
from clsplat.commands.train import say_moving
from clsplat.config import TrainConfig
from clsplat.dataset import brightness
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


def test_photos_as_a_run_trained_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = known_scene()
    moves = np.zeros(scene.train[0].image.shape[:2], bool)
    moves[5:9, 10:20] = True
    save_masks(tmp_path, {"3.png": moves})
    monkeypatch.setattr(brightness, "gains", lambda scene: {"7.png": np.full(3, 2.0)})
    for config in (TrainConfig(), TrainConfig(even_brightness=False), TrainConfig(exposure=True)):
        factor = 2 if config == TrainConfig() else 1
        for view, before in zip(as_trained(scene, tmp_path, config).train, scene.train, strict=True):
            assert (view.counts == (~moves if view.name == "3.png" else True)).all()
            darker = np.rint(before.image / (factor if view.name == "7.png" else 1))
            np.testing.assert_array_equal(view.image[before.image < 254], darker[before.image < 254])
