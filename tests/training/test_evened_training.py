"""A training on photos whose brightness is evened out, in memory and from the disk."""

# ruff: noqa: F811 (fixtures are imported and then named as arguments)
from dataclasses import replace
from pathlib import Path

import numpy as np
from small_run import same
from test_streaming import SHORT, cache, dataset, streamed  # noqa: F401  (fixtures)

from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.dataset.brightness import evened
from clsplat.device import Device
from clsplat.training.loop import train


def test_photos_are_divided_and_checkpoints_recognise_those_of_the_files(
    dataset: Path, device: Device, tmp_path: Path
) -> None:
    whole, stream = load_scene(dataset, DataConfig()), streamed(dataset)
    plain = train(whole, SHORT, tmp_path / "plain", device)
    gains = {view.name: np.array([1.2, 1.1, 0.9]) for view in whole.train[::2]}
    whole, stream = replace(whole, gains=gains), replace(stream, gains=gains)
    expected = train(whole, SHORT, tmp_path / "whole", device)
    assert not same(expected, plain)
    assert same(train(evened(whole), SHORT, tmp_path / "evened", device), expected)
    assert same(train(stream, SHORT, tmp_path / "stream", device), expected)
    assert same(train(whole, SHORT, tmp_path / "stream", device, resume=True), expected)
