"""The number of iterations follows that of the photos, unless it is given."""

import json

import pytest

from clsplat.bench.stability.small import CONFIG, small_scene
from clsplat.config import TrainConfig
from clsplat.scene import Scene
from clsplat.training.loop import train
from clsplat.training.run_length import with_iterations


@pytest.mark.parametrize(("photos", "iterations"), [(1, 3000), (100, 3000), (101, 3030), (255, 7650), (2000, 30_000)])
def test_more_photos_take_more_iterations(device, photos, iterations):
    scene = small_scene(device)
    many = Scene(scene.train[:1] * photos, [], scene.points, scene.colors)
    assert with_iterations(TrainConfig(), many).iterations == iterations
    assert with_iterations(TrainConfig(iterations=7), many).iterations == 7


def test_a_training_without_a_number_has_one(device, tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.training.run_length.FEWEST_ITERATIONS", 12)
    monkeypatch.setattr("clsplat.training.run_length.VISITS", 1)
    scene = small_scene(device)
    wanted = max(12, len(scene.train))
    train(scene, TrainConfig(init=CONFIG.init, eval_every=0), tmp_path, device)
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert log[-1]["iteration"] == wanted
