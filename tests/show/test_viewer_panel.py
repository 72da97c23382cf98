"""The viewer's panel: view, photos, edits, recordings, and curves of a training."""

import contextlib
import io
import math
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
from fake_browsers import FakeClient
from PIL import Image
from small_scenes import cameras

from clsplat.metrics import psnr, to_uint8
from clsplat.render import render
from clsplat.show.browser_cameras import client_camera, whole_view, wxyz_of
from clsplat.show.pacing import STILL_AFTER
from clsplat.show.viewer_statistics import POINTS_MAX
from clsplat.show.viewer_tasks import TASKS_MAX
from clsplat.show.viewer_thumbnails import Thumbnails


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

    def held(self, viewer, gaussians):
        """Let `hold` do what is asked, and show the result."""
        turns = iter(range(10))
        viewer.hold(gaussians, lambda: next(turns, None) is None)

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
        assert viewer._photos._shown.image.shape == (240, 320, 3)
        assert viewer._look._field.value == round(math.degrees(whole_view(cams[2], 4 / 3)))
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

    def test_thumbnails_are_made_when_asked_for_and_move_the_view(self, viewer, look, client, clock, monkeypatch):
        gaussians, cams = cameras()
        monkeypatch.setattr("clsplat.show.viewer_thumbnails.SENT_EVERY", 2)
        grid = viewer._photos._grid
        self.settled(viewer, gaussians)
        assert not grid._group.visible and grid._style.content == ""
        look("All photos")
        counts = []
        while viewer.draw(gaussians):
            counts.append(grid._style.content.count("data:image/jpeg"))
        assert grid._group.visible and not grid._button.visible
        assert sorted(set(counts)) == [0, 2, 4, 5] and counts == sorted(counts), "the grid fills between frames"
        look("Thumbnails", "3.png")
        np.testing.assert_allclose(client.state.handle.camera.position, cams[3].position)
        assert viewer._photos.selected.name == "3.png" and "button:nth-child(4)" in grid._mark.content
        assert not viewer._panel._inputs[grid._group._impl.uuid]("7.png")

    def test_of_many_photos_every_nth_is_a_thumbnail(self, viewer, monkeypatch):
        monkeypatch.setattr("clsplat.show.viewer_thumbnails.THUMBNAILS_MAX", 3)
        chosen = []
        views = viewer._photos._views
        grid = Thumbnails(viewer._panel, views, lambda handle, index: chosen.append(index), lambda task: None)
        assert list(grid._group.options) == ["0.png", "2.png", "4.png"]
        grid._group._impl.update_cb[0](SimpleNamespace(client=None, target=SimpleNamespace(value="4.png")))
        assert chosen == [4]
        grid.mark(4)
        assert "nth-child(3)" in grid._mark.content
        grid.mark(3)
        assert "nth-child(0)" in grid._mark.content, "no button"

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
        self.held(viewer, gaussians)
        whole = client.frames[-1]
        viewer._editing.select(cams[2], (0.0, 0.0), (1.0, 1.0))
        self.held(viewer, gaussians)
        assert "300 of 300 Gaussians, 289 selected" in viewer._editing._text.content
        assert client.frames[-1].mean() != whole.mean(), "what is selected is orange"
        viewer._editing.select(cams[2], (-9.0, -9.0), (9.0, 9.0))
        look("Delete selected")
        self.held(viewer, gaussians)
        assert client.notes == ["expected at least one Gaussian to remain, found none; select fewer"]
        look("Select none")
        viewer._editing.select(cams[2], (0.0, 0.0), (0.5, 1.0))
        look("Delete selected")
        look("Save")
        self.held(viewer, gaussians)
        assert 0 < saved[0] < 300 and f"saved {saved[0]}" in viewer._editing._text.content
        look("Undo")
        look("Select none")
        look("Half size", (0.5, 0.5, 0.5))
        look("Crop", "sphere")
        look("Save")
        look("Delete outside")
        look("Save")
        self.held(viewer, gaussians)
        assert saved[1] == saved[2] < 300
        look("Crop", "off")
        look("Undo")
        look("Save")
        self.held(viewer, gaussians)
        assert saved[-1] == 300

    def test_all_that_a_crop_shows_cannot_be_deleted(self, viewer, look, client):
        gaussians, cams = cameras()
        saved = []
        viewer.edit(gaussians, lambda rest: saved.append(len(rest)) or "saved")
        look("Half size", (0.5, 0.5, 0.5))
        look("Crop", "box")
        viewer._editing.select(cams[2], (-9.0, -9.0), (9.0, 9.0))
        look("Delete selected")
        look("Save")
        self.held(viewer, gaussians)
        (note,) = client.notes
        assert "in the crop region, found none; select fewer, or turn the crop off" in note
        look("Crop", "off")
        look("Delete selected")
        look("Save")
        self.held(viewer, gaussians)
        assert len(client.notes) == 1 and 0 < saved[0] < 300 and saved[1] == 300 - saved[0]

    def test_a_refused_region_leaves_the_one_before_and_its_outline(self, viewer, look, client):
        gaussians = cameras()[0]
        viewer.edit(gaussians, lambda rest: "saved")
        look("Half size", (0.5, 0.5, 0.5))
        look("Crop", "box")
        self.held(viewer, gaussians)
        region, outline = viewer._editing._edits.region, viewer._editing._outline
        look("Centre", (50.0, 50.0, 50.0))
        self.held(viewer, gaussians)
        assert client.notes == ["the region holds no Gaussian"]
        assert viewer._editing._edits.region == region
        assert viewer._editing._outline is outline and not outline._impl.removed
        look("Crop", "off")
        self.held(viewer, gaussians)
        assert viewer._editing._edits.region is viewer._editing._outline is None and outline._impl.removed

    def test_an_error_of_edits_is_shown_and_does_not_end_the_viewer(self, viewer, look, client, monkeypatch):
        gaussians = cameras()[0]
        viewer.edit(gaussians, lambda rest: "saved")

        def fails():
            raise MemoryError("no room")

        monkeypatch.setattr(viewer._editing._edits, "shown", fails)
        look("Select none")
        self.held(viewer, gaussians)
        assert client.notes == ["MemoryError: no room"]

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

    def test_a_screenshot_right_after_a_deletion_shows_what_is_left(self, viewer, look, client, device):
        gaussians, cams = cameras()
        viewer.edit(gaussians, lambda rest: "saved")
        viewer._editing.select(cams[2], (0.0, 0.0), (0.5, 1.0))
        look("Delete selected")
        look("Screenshot")
        self.held(viewer, gaussians)
        rest = viewer._editing._edits.result()
        assert 0 < len(rest) < 300
        with Image.open(io.BytesIO(client.files["clsplat.png"])) as image:
            expected = to_uint8(render(rest, cams[2], device=device).rgb)
            assert psnr(np.asarray(image), expected) > 40

    def test_a_path_is_not_squeezed_into_a_window_of_another_shape(self, viewer, look, client):
        cams = cameras()[1]
        for camera in cams[:2]:
            client.state.camera = camera
            look("Add view to path")
        window = client_camera(wxyz_of(cams[2]), cams[2].position, 1.0, 480, 480)
        found = viewer._recording._cameras(window, 7)
        for camera, expected in zip((found[0], found[-1]), cams, strict=False):
            np.testing.assert_allclose(camera.viewmat, expected.viewmat, atol=1e-12)
            np.testing.assert_allclose((camera.fx, camera.fy), 480 / 240 * expected.fy)
        assert {(c.width, c.height, c.cx, c.cy) for c in found} == {(480, 480, 240, 240)}

    def test_frames_of_a_video_do_not_pile_up(self, viewer, look, client, monkeypatch):
        pytest.importorskip("av", reason="PyAV, the extra `video`, is missing")
        frames, most = [], 0

        def rendered(renderer, gaussians, camera, *_):
            nonlocal most
            most = max(most, sum(frame() is not None for frame in frames))
            frame = np.zeros((camera.height, camera.width, 3), np.uint8)
            frames.append(weakref.ref(frame))
            return frame, ""

        monkeypatch.setattr("clsplat.show.viewer.picture", rendered)
        client.state.handle.scene.set_background_image = lambda *_, **__: None
        look("Seconds", 1)
        look("Record video")
        self.settled(viewer, cameras()[0])
        assert "clsplat.mp4" in client.files and len(frames) > 30 and most <= 2

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
