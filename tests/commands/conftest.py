"""Fixtures of the tests of commands."""

from pathlib import Path

import pytest
from cli_runs import TRAIN, run, write_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_dataset(folder)
    return folder


@pytest.fixture(scope="module")
def trained(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    run("train", dataset, "-o", out, *TRAIN)
    return out
