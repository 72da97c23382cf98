"""A training on photos whose brightness is evened out, in memory and from the disk."""

# ruff: noqa: F811 (fixtures are imported and then named as arguments)
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
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


def test_a_run_that_resumes_keeps_its_gains(dataset: Path, device: Device, tmp_path: Path) -> None:
    """Another processor, or another version, finds others."""
    scene = load_scene(dataset, DataConfig())
    gains = {view.name: np.array([1.2, 1.1, 1 / 3]) for view in scene.train[::2]}
    even = replace(scene, gains=gains)
    expected = train(even, SHORT, tmp_path / "expected", device)

    def stop(record: dict[str, Any]) -> None:
        if record["iteration"] == 20:
            raise KeyboardInterrupt

    for other in ({}, {name: factors + 1e-3 for name, factors in gains.items()}):
        out = tmp_path / f"{len(other)}"
        with pytest.raises(KeyboardInterrupt):
            train(even, SHORT, out, device, progress=stop)
        found = train(replace(scene, gains=other), SHORT, out, device, resume=True)
        assert same(found, expected)
