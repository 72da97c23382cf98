"""A dataset on disk, and the plan of its training in blocks (small_plan.py)."""

from pathlib import Path

import pytest
from cli_runs import write_dataset
from small_plan import Planned, plan

from clsplat.device import Device


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_dataset(folder, 13)
    return folder


@pytest.fixture
def planned(dataset: Path, device: Device, tmp_path: Path) -> Planned:
    return plan(dataset, device, tmp_path, 2)
