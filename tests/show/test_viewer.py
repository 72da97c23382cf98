"""The viewer: conversion of cameras, frames, trainings with a viewer, and a browser that shows the frames."""

import asyncio
import contextlib
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from browser import wait_for
from fake_browsers import FakeClient
from small_scenes import SIZE, cameras, small_training, views_of

from clsplat.errors import DeviceError, InputError
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.show.browser_cameras import client_camera, whole_view, wxyz_of
from clsplat.show.camera_paths import first_photo
from clsplat.show.frames import MODES
from clsplat.show.pacing import FRAME_TIME, STILL_AFTER, VISER_RACE
from clsplat.show.viewer import Viewer


def test_a_camera_is_the_same_after_the_conversion_to_the_browser_and_back():
    for camera in cameras()[1]:
        found = client_camera(3 * wxyz_of(camera), camera.position, whole_view(camera, 4 / 3), *SIZE)
        np.testing.assert_allclose(found.viewmat, camera.viewmat, atol=1e-12)
        np.testing.assert_allclose(found.K, camera.K, rtol=1e-12)


@pytest.mark.parametrize("window", [(300, 900), (900, 300), (320, 240)])
def test_a_window_shows_the_whole_photo(window):
    camera = replace(cameras()[1][0], fx=200.0)
    fov = whole_view(camera, window[0] / window[1])
    seen = client_camera(wxyz_of(camera), camera.position, fov, *window)
    slack = np.array([window[0] / seen.fx * camera.fx / 320, window[1] / seen.fy * camera.fy / 240])
    assert slack.min() == pytest.approx(1)


def test_without_viser_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'clsplat\[viewer\]'"):
        Viewer()


WITHOUT_THE_EXTRA = """
import sys

class Missing:
    def find_spec(self, name, *_):
        if name.split(".")[0] in ("viser", "msgspec", "websockets"):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Missing())
from clsplat.cli import main
main(sys.argv[1:])
"""


@pytest.mark.parametrize("command", [("view", "scene.ply"), ("train", "photos", "-o", "out", "--viewer")])
def test_without_the_extra_commands_end_with_a_sentence(command, tmp_path):
    """viser brings other packages, which are missing as well."""
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT_THE_EXTRA, *command],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 2 and "Traceback" not in run.stderr
    assert "pip install 'clsplat[viewer]'" in run.stderr


class TestResolution:
    def test_first_coarse_then_whole_when_still(self, viewer, device, clock):
        gaussians, cams = cameras()
        client = FakeClient(viewer, cams[1])
        assert viewer.draw(gaussians)
        assert client.frames[0].shape[1] == SIZE[0] / 4
        assert not viewer.draw(gaussians), "nothing is due while the camera may still be moving"
        clock.now += STILL_AFTER
        while viewer.draw(gaussians):
            pass
        assert [f.shape[1] for f in client.frames] == sorted({f.shape[1] for f in client.frames})
        np.testing.assert_array_equal(client.frames[-1], to_uint8(render(gaussians, cams[1], device=device).rgb))
        assert not viewer.draw(gaussians), "and nothing more"

    def test_a_race_in_viser_loses_no_frame(self, viewer, clock, recwarn):
        client = FakeClient(viewer, cameras()[1][0])
        show = client.state.handle.scene.set_background_image

        calls = []

        def racing(frame, **options):
            calls.append(frame)
            if len(calls) == 1:
                raise RuntimeError(VISER_RACE)
            show(frame, **options)

        client.state.handle.scene.set_background_image = racing
        assert viewer.draw(cameras()[0])
        assert len(client.frames) == 1 and not recwarn.list

    def test_a_movement_is_drawn_at_once_and_in_time(self, viewer, monkeypatch, clock):
        """If the time of a frame is proportional to its pixels, frames converge to FRAME_TIME."""
        gaussians, cams = cameras()

        def slow(device, gaussians, camera, *_):
            clock.now += 0.5 * camera.width * camera.height / (SIZE[0] * SIZE[1])
            return np.zeros((camera.height, camera.width, 3), np.uint8), ""

        monkeypatch.setattr("clsplat.show.viewer.picture", slow)
        client = FakeClient(viewer, cams[0])
        for i in range(12):
            client.state.camera, client.state.moved = cams[i % 5], clock.now
            before = clock.now
            assert viewer.draw(gaussians)
        assert clock.now - before == pytest.approx(FRAME_TIME, rel=0.1)

    def test_the_frames_of_a_training_take_a_limited_share_of_its_time(self, viewer, clock):
        gaussians, cams = cameras()
        client = FakeClient(viewer, cams[0])
        clock.now += STILL_AFTER
        while viewer.draw(gaussians):
            pass
        client.state.shown = shown = client.state.shown._replace(seconds=1.0)
        clock.now = shown.at + 9  # a frame that takes 1 s is due every 10 s
        viewer.follow(gaussians, lambda: False)
        assert client.state.shown is shown
        clock.now = shown.at + 10
        viewer.follow(gaussians, lambda: False)
        assert client.state.shown is not shown and client.state.shown.share == 1

    def test_a_lack_of_memory_does_not_end_the_training(self, viewer, monkeypatch):
        gaussians, cams = cameras()

        def fails(*_):
            raise DeviceError("image: needs a buffer of 9 MiB")

        monkeypatch.setattr("clsplat.show.viewer.picture", fails)
        client = FakeClient(viewer, cams[0])
        assert viewer.draw(gaussians)
        assert client.frames[0].shape == (1, 1, 3)
        assert "needs a buffer" in viewer._drawn


@pytest.mark.parametrize("optimizer", ["device", "numpy"])
def test_training_has_the_same_bits_with_a_viewer(viewer, device, tmp_path, optimizer):
    alone = small_training(device, tmp_path / "alone", optimizer=optimizer)
    cams, client = cameras()[1], FakeClient(viewer, cameras()[1][0])

    def watched(record):
        viewer._look._mode.value = MODES[record["iteration"] % len(MODES)]
        client.state.camera = cams[record["iteration"] % 5]
        viewer.follow(record["gaussians"], lambda: False)

    beside = small_training(device, tmp_path / "beside", watched, optimizer=optimizer)
    assert len(client.frames) == 12
    for name, array in alone.arrays().items():
        np.testing.assert_array_equal(array, beside.arrays()[name], err_msg=name)


def test_a_pause_holds_the_training_until_it_is_resumed_or_interrupted(viewer, device, tmp_path):
    reached = []

    def resume():
        wait_for(lambda: viewer._paused and reached, "the pause")
        time.sleep(0.3)
        resumed.append(len(reached))
        viewer._toggle(None)

    def watched(record):
        reached.append(record["iteration"])
        if record["iteration"] == 3:
            viewer._toggle(None)
        viewer.follow(record["gaussians"], lambda: False)

    resumed = []
    thread = threading.Thread(target=resume)
    thread.start()
    small_training(device, tmp_path / "run", watched)
    thread.join()
    assert resumed == [3]
    assert len(reached) == 12
    viewer._toggle(None)
    viewer.follow(cameras()[0], lambda: True)  # without the interruption it would wait forever


class Joining(dict):
    """Clients of a viewer, to whose scene `show` wants to add while a browser joins."""

    def __init__(self, show):
        super().__init__()
        self.owner = threading.Thread(target=show)

    def __setitem__(self, key, value):
        self.owner.start()
        self.owner.join(1)  # without a lock, the time suffices
        super().__setitem__(key, value)


def test_a_browser_that_joins_while_a_scene_is_added_gets_its_view_and_outlines(device):
    pytest.importorskip("viser", reason="viser, the extra `viewer`, is missing")
    cams, renderer, added = cameras()[1], Renderer(device), []
    viewer = Viewer(port=18080)

    def outline(name, **_):
        added.append(name)
        return SimpleNamespace(on_click=lambda callback: None)

    camera = SimpleNamespace(
        wxyz=(1, 0, 0, 0),
        position=(3, 3, 3),
        fov=1,
        image_width=320,
        image_height=240,
        on_update=lambda callback: None,
    )
    scene = SimpleNamespace(add_camera_frustum=outline, set_background_image=lambda *_, **__: None)
    handle = SimpleNamespace(client_id=0, camera=camera, scene=scene, atomic=contextlib.nullcontext)
    try:
        viewer._clients = Joining(lambda: viewer.show(renderer, first_photo(cams), views_of(cams)))
        asyncio.run(viewer._connect(handle))
        viewer._clients.owner.join()
        np.testing.assert_allclose(camera.position, cams[0].position)
        assert added == [f"/cameras/{i}.png" for i in range(5)]
        assert list(viewer._clients[0].outlines) == list(range(5))
    finally:
        viewer.close()
