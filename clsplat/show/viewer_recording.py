"""Inputs of the viewer for pictures and videos, which the browser downloads."""

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.show.camera_paths import Viewpoint, around, through
from clsplat.show.viewer_panel import Panel

FRAMES_PER_SECOND = 30
"""Frames per second of a video."""

SECONDS_MAX = 60
"""Longest video, s."""

VIDEO_EDGE = 1280
"""Longer edge of a video, px."""


class Recording:
    """Maker of the inputs, which renders on the thread that owns the device.

    Parameters
    ----------
    panel : Panel
    start : Viewpoint
        Without views, a video circles its focus.
    pose_of : callable
        Camera of a browser by its identifier; None if it has left.
    later : callable
        Takes a function of the Gaussians that the owner of the device calls.
    frame_of : callable
        Renders a camera's frame of Gaussians with the settings of the panel; returns it with its legend.
    """

    def __init__(
        self,
        panel: Panel,
        start: Viewpoint,
        pose_of: Callable[[int], Camera | None],
        later: Callable[[Any], None],
        frame_of: Callable[[Camera, Gaussians], tuple[NDArray[np.uint8], str]],
    ):
        self._start, self._pose_of, self._later, self._frame_of = start, pose_of, later, frame_of
        self._path: list[Camera] = []
        panel.button("Screenshot", self._screenshot)
        panel.button("Add view to path", self._add)
        panel.button("Clear path", lambda _: self._clear())
        self._seconds = panel.slider("Seconds", (1, SECONDS_MAX), 1, 6)
        self._closed = panel.checkbox("Closed path", False)
        panel.button("Record video", self._record)
        self._text = panel.gui.add_markdown("")
        self._clear()

    def _clear(self) -> None:
        self._path.clear()
        self._text.content = "0 views: the video circles the scene"

    def _add(self, event: Any) -> None:
        camera = self._pose_of(event.client_id)
        if camera is not None:
            self._path.append(camera)
            self._text.content = f"{len(self._path)} view{'s' * (len(self._path) > 1)}"

    def _screenshot(self, event: Any) -> None:
        camera = self._pose_of(event.client_id)
        if camera is None:
            return

        def task(gaussians: Gaussians) -> None:
            file = io.BytesIO()
            Image.fromarray(self._frame_of(camera, gaussians)[0]).save(file, "PNG")
            event.client.send_file_download("clsplat.png", file.getvalue(), save_immediately=True)

        self._later(task)

    def _record(self, event: Any) -> None:
        window = self._pose_of(event.client_id)
        if window is None:
            return
        count = round(self._seconds.value * FRAMES_PER_SECOND)

        def task(gaussians: Gaussians) -> Iterator[None]:
            file, cameras = io.BytesIO(), self._cameras(window, count)
            with encoder(file, cameras[0].width, cameras[0].height) as encode:
                for number, camera in enumerate(cameras, start=1):
                    encode(self._frame_of(camera, gaussians)[0])
                    self._text.content = f"frame {number} of {count}"
                    yield
            event.client.send_file_download("clsplat.mp4", file.getvalue(), save_immediately=True)
            self._text.content = f"{count} frames recorded"

        self._later(task)

    def _cameras(self, window: Camera, count: int) -> list[Camera]:
        """The path, at a size with even edges, which H.264 needs."""
        scale = min(1.0, VIDEO_EDGE / max(window.width, window.height))
        width, height = (max(2, 2 * round(scale * edge / 2)) for edge in (window.width, window.height))
        first = window.resized(width, height)
        if len(self._path) > 1:
            return through([_in_window(camera, first) for camera in self._path], count, closed=self._closed.value)
        return around(first, self._start.focus, self._start.up, count)


def _in_window(camera: Camera, window: Camera) -> Camera:
    """What a window of another size shows of a browser's view: the vertical field of view stays."""
    zoom = camera.fy / camera.height * window.height / window.fy
    return replace(window, viewmat=camera.viewmat, fx=zoom * window.fx, fy=zoom * window.fy)


@contextmanager
def encoder(file: BinaryIO, width: int, height: int) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Write a video of `width` x `height` px, both even, as MP4, H.264: the block calls what it gets with each frame.

    Frames, (height, width, 3) uint8, are encoded one by one: those of a minute would take gigabytes.

    Raises
    ------
    InputError
        If the package av is missing.
    """
    try:
        import av
    except ImportError as error:
        raise InputError("cannot write a video: the package av is missing; pip install 'clsplat[video]'") from error
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("h264", rate=FRAMES_PER_SECOND, options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"

        def encode(frame: NDArray[np.uint8]) -> None:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))

        yield encode
        container.mux(stream.encode())
