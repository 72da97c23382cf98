"""A clock and a browser for tests of the viewer, without a connection."""

from types import SimpleNamespace

from clsplat.show.pacing import Client


class Clock:
    """The viewer's clock: each reading takes a millisecond, and a test can add time."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        self.now += 1e-3
        return self.now


class FakeClient:
    """A browser that records the frames it is sent."""

    def __init__(self, viewer, camera, moved=0.0):
        self.frames = []
        scene = SimpleNamespace(set_background_image=lambda frame, **_: self.frames.append(frame))
        self.notes = []
        handle = SimpleNamespace(scene=scene, add_notification=lambda title, text, **_: self.notes.append(text))
        self.state = viewer._clients[0] = Client(handle, camera, moved)
