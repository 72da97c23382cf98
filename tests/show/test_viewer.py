"""The viewer: conversion of cameras, frames, trainings with a viewer, and a browser that shows the frames."""

import contextlib
import io
import math
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from browser import browser, wait_for
from PIL import Image
from small_scenes import SIZE, cameras, small_training, views_of

from clsplat.errors import DeviceError, InputError
from clsplat.metrics import psnr, to_uint8
from clsplat.ops import count_pairs
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.show.browser_cameras import client_camera, whole_view, wxyz_of
from clsplat.show.camera_paths import first_photo
from clsplat.show.frames import MODES, Look, picture
from clsplat.show.pacing import FRAME_TIME, STILL_AFTER, VISER_RACE, Client
from clsplat.show.viewer import Viewer
from clsplat.show.viewer_statistics import POINTS_MAX
from clsplat.show.viewer_tasks import TASKS_MAX


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


class TestPicture:
    def test_render_is_the_image_of_render(self, device):
        gaussians, (camera, *_) = cameras()
        frame, legend = picture(Renderer(device, background=(1.0, 0.0, 0.5)), gaussians, camera)
        ours = render(gaussians, camera, device=device, background=(1.0, 0.0, 0.5))
        np.testing.assert_array_equal(frame, to_uint8(ours.rgb))
        assert legend == ""

    def test_depth_alpha_and_count_and_their_legends(self, device):
        gaussians, (camera, *_) = cameras()
        gaussians.logit_opacities[:] = 4
        ours = render(gaussians, camera, device=device, depth=True)
        shown = {
            mode: picture(Renderer(device, background=(0.0, 0.0, 0.0)), gaussians, camera, Look(mode))
            for mode in MODES
        }
        alpha = np.repeat(ours.alpha[:, :, None], 3, axis=2)
        np.testing.assert_array_equal(shown["alpha"][0], to_uint8(alpha))
        solid = ours.alpha > 0.5
        assert 0 < solid.mean() < 1
        assert not shown["depth"][0][~solid].any()
        brightness = shown["depth"][0].sum(axis=2)[solid].astype(float)
        assert np.corrcoef(brightness, ours.depth[solid])[0, 1] < -0.8, "near must be bright"
        near, far = np.percentile(ours.depth[solid], [2, 98])
        assert f"bright {near:.3g}, dark {far:.3g}" in shown["depth"][1]
        run = Renderer(device).forward(gaussians, camera, 0, gradients=False)
        count = count_pairs(device, run.splats, run.bins)[1].get()
        assert f"bright {count.max()} Gaussians per pixel; mean {count.mean():.1f}" in shown["count"][1]
        order = np.argsort(count, axis=None)[[0, -1]]
        darkest, brightest = shown["count"][0].sum(axis=2).ravel()[order]
        assert darkest < brightest == shown["count"][0].sum(axis=2).max()

    def test_an_empty_view_has_no_depth(self, device):
        gaussians, (camera, *_) = cameras()
        gaussians.logit_opacities[:] = -20
        frame, legend = picture(Renderer(device, background=(1.0, 1.0, 1.0)), gaussians, camera, Look("depth"))
        assert not frame.any()
        assert legend == "nothing opaque in view"


def test_without_viser_the_message_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'clsplat\[viewer\]'"):
        Viewer()


class Clock:
    """The viewer's clock: each reading takes a millisecond, and a test can add time."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        self.now += 1e-3
        return self.now


@pytest.fixture
def clock(monkeypatch):
    result = Clock()
    monkeypatch.setattr("clsplat.show.viewer.time", result)
    monkeypatch.setattr("clsplat.show.viewer_statistics.time", result)
    return result


class FakeClient:
    """A browser that records the frames it is sent."""

    def __init__(self, viewer, camera, moved=0.0):
        self.frames = []
        scene = SimpleNamespace(set_background_image=lambda frame, **_: self.frames.append(frame))
        self.notes = []
        handle = SimpleNamespace(scene=scene, add_notification=lambda title, text, **_: self.notes.append(text))
        self.state = viewer._clients[0] = Client(handle, camera, moved)


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


BARE = np.s_[160:, :290]
"""Rows and columns of a page of 640x480 that neither the panel nor viser's notification covers."""

# Elements of the panel: the field with the mode, and the last checkbox.
CLICK_CAMERAS = "[...document.querySelectorAll('input[type=checkbox]')].at(-1).click()"
MODE_BOX = """(() => {
    const box = [...document.querySelectorAll('input')].find(i => i.value == 'render').getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2];
})()"""
CHOOSE_ALPHA = """(() => {
    const option = [...document.querySelectorAll('[role=option]')].find(o => o.innerText == 'alpha');
    option?.click();
    return Boolean(option);
})()"""


def test_a_browser_shows_the_render_and_moves_to_a_clicked_camera(viewer, device, tmp_path):
    gaussians, cams = cameras()
    stop = threading.Event()
    owner = threading.Thread(target=viewer.hold, args=(gaussians, stop.is_set))
    owner.start()

    def seen(page):
        """Index of the camera whose render the page shows where nothing covers it, or None.

        The threshold is 20 dB: the right camera reaches 24 to 27 dB (a frame is a JPEG with frusta drawn over it),
        others up to 15 dB.
        """
        shot = page.screenshot()[BARE]
        scores = [psnr(shot, to_uint8(render(gaussians, c, device=device).rgb)[BARE]) for c in whole]
        return int(np.argmax(scores)) if max(scores) > 20 else None

    whole = [camera.resized(640, 480) for camera in cams]
    try:
        with browser(tmp_path, viewer.address, 640, 480) as page:
            wait_for(lambda: viewer._clients, "the browser's connection")
            (client,) = viewer._clients.values()
            wait_for(lambda: client.shown and client.shown.share == 1 and seen(page) == 0, "the first camera's frame")
            np.testing.assert_allclose(client.camera.viewmat, cams[0].viewmat, atol=1e-4)
            for here, there in pairwise((0, 3, 1)):
                x, y, z = (whole[here].viewmat @ [*cams[there].position, 1])[:3]
                where = whole[here].fx * x / z + 320, whole[here].fy * y / z + 240

                def arrived(where=where, there=there):
                    if np.abs(client.camera.viewmat - cams[there].viewmat).max() > 1e-3:
                        page.click(*where)  # again, in case the page was busy
                        time.sleep(1)
                    return seen(page) == there

                wait_for(arrived, f"the frame of camera {there}, clicked at {where}")
            page.open_tab("Photos")
            page.evaluate(CLICK_CAMERAS)
            wait_for(lambda: not any(o.visible for o in client.outlines.values()), "hidden cameras")
            page.open_tab("View")
            page.click(*page.evaluate(MODE_BOX))
            wait_for(lambda: page.evaluate(CHOOSE_ALPHA), "the list of modes")
            wait_for(
                lambda: viewer._look.look().mode == "alpha" and client.shown.share == 1, "a frame of another mode"
            )
            alpha = picture(Renderer(device, background=(0.0, 0.0, 0.0)), gaussians, whole[1], Look("alpha"))[0]
            # A JPEG reaches 25 dB once the frusta no longer cover it.
            wait_for(lambda: psnr(page.screenshot()[BARE], alpha[BARE]) > 25, "alpha")
    finally:
        stop.set()
        owner.join()


class TestPanel:
    """What the panel's inputs do, without a browser; clients are records of what they are sent."""

    @pytest.fixture
    def look(self, viewer):
        """Set an input of the panel by its label, as a message of a page does; or click a button."""

        def change(label, value=True):
            handles = viewer._server.gui._gui_input_handle_from_uuid.values()
            (handle,) = (h for h in handles if h._impl.props.label == label)
            assert viewer._panel._inputs[handle._impl.uuid](value)
            handle._impl.value = value
            event = SimpleNamespace(client=viewer._clients[0].handle, client_id=0, target=handle)
            for callback in handle._impl.update_cb:
                callback(event)

        return change

    @pytest.fixture
    def client(self, viewer):
        client = FakeClient(viewer, cameras()[1][2])
        client.files = {}
        client.state.handle.send_file_download = lambda name, data, **_: client.files.update({name: data})
        client.state.handle.camera = SimpleNamespace(aspect=4 / 3)
        client.state.handle.atomic = contextlib.nullcontext
        return client

    def settled(self, viewer, gaussians):
        while viewer.draw(gaussians):
            pass

    def test_background_harmonics_and_field_of_view(self, viewer, look, client, clock):
        gaussians = cameras()[0]
        clock.now += STILL_AFTER
        self.settled(viewer, gaussians)
        for label, value in (("Background", (0, 255, 0)), ("Harmonics", 0)):
            before, count = client.frames[-1], len(client.frames)
            look(label, value)
            clock.now += STILL_AFTER
            self.settled(viewer, gaussians)
            assert len(client.frames) > count and (client.frames[-1] != before).any(), label
        look("Field of view", 90)
        assert client.state.handle.camera.fov == pytest.approx(math.pi / 2)

    def test_a_photo_is_chosen_compared_and_left(self, viewer, look, client, clock):
        gaussians, cams = cameras()
        viewer._photos._views[2].image[:] = (255, 0, 255)
        clock.now += STILL_AFTER
        self.settled(viewer, gaussians)
        plain = client.frames[-1]
        look("Photo", "2.png")
        np.testing.assert_allclose(client.state.handle.camera.position, cams[2].position)
        assert client.state.handle.camera.fov == pytest.approx(whole_view(cams[2], 4 / 3))
        assert viewer._photos._thumbnail.image.shape == (240, 320, 3)
        look("Compare", "overlay")
        look("Photo's share", 100)
        self.settled(viewer, gaussians)
        assert (client.frames[-1] == (255, 0, 255)).all()
        look("Compare", "beside")
        look("Photo's share", 25)
        self.settled(viewer, gaussians)
        assert (client.frames[-1][:, :79] == (255, 0, 255)).all()
        np.testing.assert_array_equal(client.frames[-1][:, 82:], plain[:, 82:])
        client.state.camera = cams[3]  # another view than the photo's
        clock.now += STILL_AFTER
        self.settled(viewer, gaussians)
        assert not (client.frames[-1] == (255, 0, 255)).all(axis=2).any()
        look("Next")
        np.testing.assert_allclose(client.state.handle.camera.position, cams[3].position)
        assert viewer._photos.selected.name == "3.png"

    def test_outlines_fade_with_distance_and_the_one_looked_through_is_hidden(self, viewer, look):
        cams = cameras()[1]
        outlines = {i: SimpleNamespace(visible=True, color=(255, 140, 0)) for i in range(5)}
        viewer._photos.fade(outlines, cams[1])
        assert [outlines[i].visible for i in range(5)] == [True, False, True, True, True]
        away = [np.linalg.norm(c.position - cams[1].position) for c in cams]
        shades = [sum(outlines[i].color) for i in sorted((0, 2, 3, 4), key=lambda i: away[i])]
        assert shades == sorted(shades, reverse=True) and shades[0] > shades[-1] > 0

    def test_edits_are_shown_undone_and_saved(self, viewer, look, client, clock):
        gaussians, cams = cameras()
        saved = []
        viewer.edit(gaussians, lambda rest: saved.append(len(rest)) or f"saved {len(rest)}")
        held = {"left": 3}

        def hold():
            held["left"] = 3
            viewer.hold(gaussians, lambda: (held.update(left=held["left"] - 1), held["left"] < 0)[1])

        hold()
        whole = client.frames[-1]
        viewer._editing.select(cams[2], (0.0, 0.0), (1.0, 1.0))
        hold()
        assert "300 of 300 Gaussians, 289 selected" in viewer._editing._text.content
        assert client.frames[-1].mean() != whole.mean(), "what is selected is orange"
        viewer._editing.select(cams[2], (-9.0, -9.0), (9.0, 9.0))
        look("Delete selected")
        hold()
        assert client.notes == ["expected at least one Gaussian to remain, found none"]
        look("Select none")
        viewer._editing.select(cams[2], (0.0, 0.0), (0.5, 1.0))
        look("Delete selected")
        look("Save")
        hold()
        assert 0 < saved[0] < 300 and f"saved {saved[0]}" in viewer._editing._text.content
        look("Undo")
        look("Select none")
        look("Half size", (0.5, 0.5, 0.5))
        look("Crop", "sphere")
        look("Save")
        look("Delete outside")
        look("Save")
        hold()
        assert saved[1] == saved[2] < 300
        look("Crop", "off")
        look("Undo")
        look("Save")
        hold()
        assert saved[-1] == 300

    def test_screenshot_and_videos(self, viewer, look, client, device):
        gaussians, cams = cameras()
        look("Screenshot")
        self.settled(viewer, gaussians)
        with Image.open(io.BytesIO(client.files["clsplat.png"])) as image:
            expected = to_uint8(render(gaussians, cams[2], device=device).rgb)
            np.testing.assert_array_equal(np.asarray(image), expected)
        av = pytest.importorskip("av", reason="PyAV, the extra `video`, is missing")
        look("Seconds", 1)
        for views in (0, 2):
            for camera in cams[:views]:
                client.state.camera = camera
                look("Add view to path")
            client.files.clear()
            look("Record video")
            self.settled(viewer, gaussians)
            with av.open(io.BytesIO(client.files["clsplat.mp4"])) as container:
                frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
            assert len(frames) == 30 and frames[0].shape == (240, 320, 3)
        first, last = (to_uint8(render(gaussians, c, device=device).rgb) for c in cams[:2])
        assert psnr(frames[0], first) > 25 and psnr(frames[-1], last) > 25

    def test_tasks_do_not_pile_up(self, viewer, look, client):
        for _ in range(3 * TASKS_MAX):
            look("Screenshot")
        assert len(viewer._tasks._waiting) == TASKS_MAX

    def test_curves_of_a_training(self, viewer, clock):
        for iteration in range(1, 3001):
            clock.now += 0.5
            viewer.record(iteration, 100 + iteration, 20.0 + iteration / 100 if iteration % 500 == 0 else None)
        plots = viewer._statistics._plots
        assert plots["PSNR, dB"].data[1].tolist() == [25, 30, 35, 40, 45, 50]
        iterations, counts = plots["Gaussians"].data
        np.testing.assert_array_equal(counts, iterations + 100)
        assert 100 < len(iterations) <= POINTS_MAX and iterations[-1] >= 2998
        np.testing.assert_allclose(plots["it/s"].data[1], 2, rtol=0.02)


def test_a_page_says_what_it_waits_for():
    pytest.importorskip("viser", reason="viser, the extra `viewer`, is missing")
    viewer = Viewer(port=18080)
    try:
        client = FakeClient(viewer, cameras()[1][0])
        viewer.wait("recovering cameras")
        assert "recovering cameras" in viewer._text.content
        dark = client.frames[-1]
        assert dark.shape == (240, 320, 3) and 0 < (dark > 120).mean() < 0.2
        assert not viewer.draw(cameras()[0]), "there is nothing to draw with yet"
    finally:
        viewer.close()


def test_a_browser_selects_and_deletes_what_is_under_a_rectangle(viewer, tmp_path):
    gaussians = cameras()[0]
    saved = []
    viewer.edit(gaussians, lambda rest: saved.append(rest) or "saved")
    stop = threading.Event()
    owner = threading.Thread(target=viewer.hold, args=(gaussians, stop.is_set))
    owner.start()
    edits = viewer._editing._edits
    try:
        with browser(tmp_path, viewer.address, 640, 480) as page:
            wait_for(lambda: [c for c in viewer._clients.values() if c.shown], "the first frame")
            page.open_tab("Edit")

            def selected():
                page.drag((40, 200), (280, 450), shift=True)  # again, in case the page was busy
                time.sleep(1)
                return edits.selected.any()

            wait_for(selected, "a selection")
            (client,) = viewer._clients.values()
            x, y, z = (client.camera.viewmat[:3] @ np.vstack([gaussians.means.T, np.ones(300)])).astype(np.float64)
            u, v = client.camera.fx * x / z + 320, client.camera.fy * y / z + 240
            inside = (u > 40) & (u < 280) & (v > 200) & (v < 450)
            edge = np.minimum(np.abs(u[:, None] - (40, 280)), np.abs(v[:, None] - (200, 450))).min(axis=1) < 2
            np.testing.assert_array_equal(edits.selected[~edge], inside[~edge])
            count = int(edits.selected.sum())
            page.press("Delete selected")
            wait_for(lambda: len(edits) == 300 - count, "the deletion")
            page.press("Save")
            wait_for(lambda: saved, "the saved scene")
            assert len(saved[0]) == 300 - count
            page.press("Undo")
            wait_for(lambda: len(edits) == 300, "what was deleted")
    finally:
        stop.set()
        owner.join()


def test_a_browser_follows_a_training_from_its_wait_to_its_curves(device, tmp_path):
    pytest.importorskip("viser", reason="viser, the extra `viewer`, is missing")
    stop, cams = threading.Event(), cameras()[1]
    viewer = Viewer(port=18080)
    viewer.wait("recovering cameras")

    def progress(record):
        if record["iteration"] == 1:
            viewer.show(Renderer(device), first_photo(cams), views_of(cams))
        viewer.record(record["iteration"], record["num_gaussians"], 20.0 + record["iteration"] / 1e5)
        viewer.tell({"Iteration": str(record["iteration"])})
        viewer.follow(record["gaussians"], stop.is_set)
        if stop.is_set():
            raise KeyboardInterrupt

    def training():
        with contextlib.suppress(KeyboardInterrupt):
            small_training(device, tmp_path / "run", progress, iterations=10**6, checkpoint_every=10**6)

    owner = threading.Thread(target=training)
    try:
        with browser(tmp_path / "profile", viewer.address, 640, 480) as page:

            def text():
                return page.evaluate("document.body.innerText")

            wait_for(lambda: "Waiting recovering cameras" in text(), "what the viewer waits for")
            owner.start()
            wait_for(lambda: [c for c in viewer._clients.values() if c.shown], "the first frame")
            wait_for(lambda: "Iteration" in text() and "Waiting" not in text(), "the state of the training")
            (client,) = viewer._clients.values()
            wait_for(lambda: np.abs(client.camera.viewmat - cams[0].viewmat).max() < 1e-3, "the first photo's view")
            wait_for(lambda: page.screenshot()[BARE].std() > 20, "a picture of the scene")
            page.open_tab("Training")
            wait_for(lambda: page.evaluate("document.querySelectorAll('.uplot canvas').length") == 3, "three curves")
            page.press("Pause training")
            wait_for(lambda: viewer._paused and "Resume training" in text(), "the pause")
    finally:
        stop.set()
        if owner.is_alive():
            owner.join()
        viewer.close()
