"""Iterations and the size of the first photos follow the photos, unless they are given."""

import json

import numpy as np
import pytest

from clsplat.bench.stability.small import CONFIG, small_scene
from clsplat.camera import Camera
from clsplat.config import CoarseConfig, TrainConfig
from clsplat.scene import Scene, View
from clsplat.training.loop import train
from clsplat.training.run_length import with_length


@pytest.mark.parametrize(
    ("photos", "iterations"),
    [(1, 1500), (16, 1500), (17, 3000), (100, 3000), (101, 3030), (255, 7650), (2000, 30_000)],
)
def test_more_photos_take_more_iterations(device, photos, iterations):
    scene = small_scene(device)
    many = Scene(scene.train[:1] * photos, [], scene.points, scene.colors)
    assert with_length(TrainConfig(), many).iterations == iterations
    assert with_length(TrainConfig(iterations=7), many).iterations == 7


def with_photos(width: int, height: int, count: int) -> Scene:
    camera = Camera(np.eye(4), width, width, width / 2, height / 2, width, height)
    views = [View(f"{k}.png", camera, np.zeros((height, width, 3), np.uint8)) for k in range(count)]
    return Scene(views, [], np.zeros((1, 3)), np.zeros((1, 3)))


@pytest.mark.parametrize(
    ("size", "count", "iterations", "factor"),
    [
        ((300, 300), 17, 3000, 1),
        ((600, 600), 17, 4243, 4),
        ((600, 600), 3, 2121, 4),
        ((600, 600), 300, 9000, 4),
        ((6000, 4000), 17, 12_123, 4),
    ],
)
def test_larger_photos_take_more_iterations_and_start_smaller(size, count, iterations, factor):
    scene = with_photos(*size, 1)
    scene = Scene(scene.train * count, [], scene.points, scene.colors)
    config = with_length(TrainConfig(), scene)
    assert (config.iterations, config.coarse.factor) == (iterations, factor)
    given = TrainConfig(iterations=7, coarse=CoarseConfig(factor=2))
    assert with_length(given, scene) == given
    fixed = with_length(TrainConfig(size="fixed"), scene)
    assert (fixed.iterations, fixed.coarse.factor) == (iterations, 1)


def test_a_training_without_a_number_has_one(device, tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.training.run_length.FEWEST_ITERATIONS", 12)
    monkeypatch.setattr("clsplat.training.run_length.VISITS", 1)
    scene = small_scene(device)
    wanted = max(12, len(scene.train))
    train(scene, TrainConfig(init=CONFIG.init, eval_every=0), tmp_path, device)
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert log[-1]["iteration"] == wanted
