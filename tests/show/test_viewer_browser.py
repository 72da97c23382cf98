"""The viewer's page in headless Chromium: frames, cameras, edits, and a training from its wait to its curves."""

import contextlib
import threading
import time
from itertools import pairwise

import numpy as np
import pytest
from browser import browser, wait_for
from fake_browsers import FakeClient
from small_scenes import cameras, small_training, views_of

from clsplat.metrics import psnr, to_uint8
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.show.camera_paths import first_photo
from clsplat.show.frames import Look, picture
from clsplat.show.viewer import Viewer

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


def test_a_browser_moves_to_a_clicked_thumbnail(viewer, tmp_path):
    gaussians, cams = cameras()
    viewer._photos._views[2].image[:] = (255, 0, 255)
    stop = threading.Event()
    owner = threading.Thread(target=viewer.hold, args=(gaussians, stop.is_set))
    owner.start()
    button = "[...document.querySelectorAll('button')].find(b => b.innerText.trim() == '2.png')"
    try:
        with browser(tmp_path, viewer.address, 640, 480) as page:
            wait_for(lambda: [c for c in viewer._clients.values() if c.shown], "the first frame")
            (client,) = viewer._clients.values()
            page.open_tab("Photos")
            page.press("All photos")
            wait_for(lambda: page.evaluate(f"Boolean({button})"), "the thumbnails")

            def middle():
                """Of the thumbnail; its picture has come if it is magenta."""
                page.evaluate(f"{button}.scrollIntoView({{block: 'center'}})")
                time.sleep(0.5)
                box = page.evaluate(f"(() => {{ const b = {button}.getBoundingClientRect(); return [b.x, b.y]; }})()")
                return round(box[0]) + 33, round(box[1]) + 25

            def drawn():
                x, y = middle()
                return np.abs(page.screenshot()[y, x].astype(int) - (255, 0, 255)).max() < 30

            wait_for(drawn, "the picture of the thumbnail")
            page.click(*middle())
            wait_for(lambda: np.abs(client.camera.viewmat - cams[2].viewmat).max() < 1e-3, "the view of its camera")
    finally:
        stop.set()
        owner.join()


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
