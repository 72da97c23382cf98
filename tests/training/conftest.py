"""The scene of the small training (small_run.py), and a dataset on disk."""

from pathlib import Path

import pytest
from cli_runs import write_dataset
from small_run import known_scene

from clsplat.scene import Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return known_scene()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_dataset(folder)
    return folder
