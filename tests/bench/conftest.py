"""Fixtures of the benchmarks' tests."""

import json
from pathlib import Path

import pytest
from cli_runs import write_dataset
from small_cells import SMALL

from clsplat.bench import networks, roof


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two scenes of 9 photos, two of them held out, and two methods."""
    folder = tmp_path_factory.mktemp("quality")
    for name in ("one", "two"):
        write_dataset(folder / name)
    (folder / "plain.json").write_text(json.dumps(SMALL))
    (folder / "capped.json").write_text(json.dumps(SMALL | {"strategy": "error", "max_gaussians": 100}))
    return folder


@pytest.fixture
def quick_roof(monkeypatch):
    """Micro-benchmarks that take milliseconds."""
    for name, value in {"SECONDS": 1e-4, "RUNS": 1, "LAUNCHES": 5, "BUFFER_BYTES": 2**20}.items():
        monkeypatch.setattr(roof, name, value)
    monkeypatch.setattr(networks, "OPERATIONS", 2**17)
