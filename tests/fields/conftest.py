"""Fixtures of the fields' tests."""

import pytest
from ball_photos import ball

from clsplat.scene import Scene


@pytest.fixture
def long_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """An eighth of the samples on a ray: the photos are small, too."""
    monkeypatch.setattr("clsplat.fields.space.STEP", 3**0.5 / 128)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A ball, seen from all around."""
    return ball()
