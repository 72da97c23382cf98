"""The scene of the small training (small_run.py)."""

import pytest
from small_run import known_scene

from clsplat.scene import Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return known_scene()
