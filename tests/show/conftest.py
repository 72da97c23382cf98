"""Fixtures of the viewer's tests."""

import pytest
from fake_browsers import Clock
from small_scenes import cameras, views_of

from clsplat.renderer import Renderer
from clsplat.show.camera_paths import first_photo
from clsplat.show.viewer import Viewer


@pytest.fixture
def viewer(device):
    """A viewer of five cameras. A test adds its clients."""
    pytest.importorskip("viser", reason="viser, the extra `viewer`, is missing")
    cams = cameras()[1]
    result = Viewer(port=18080)
    result.show(Renderer(device), first_photo(cams), views_of(cams))
    yield result
    result.close()


@pytest.fixture
def clock(monkeypatch):
    result = Clock()
    monkeypatch.setattr("clsplat.show.viewer.time", result)
    monkeypatch.setattr("clsplat.show.viewer_statistics.time", result)
    return result
