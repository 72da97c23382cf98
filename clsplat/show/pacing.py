"""Times and resolutions of a browser's frames: coarse while the camera moves, then refined."""

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from clsplat.camera import Camera

FRAME_TIME = 1 / 20
"""Time of a frame while the camera moves, s. The resolution is chosen to keep it. With the time on the way to the
screen, a browser shows more than 15 frames per second, from which on a movement looks continuous."""

STILL_AFTER = 0.25
"""Time without a movement after which frames are refined, up to the size of the window, s."""

SMALLEST_SHARE = 1 / 4
"""Smallest resolution of a frame while the camera moves, as a fraction of the window's edges. Below it, projecting
and sorting the Gaussians takes most of the time (docs/howto/viewer.md), and frames only become coarser."""

TRAINING_SHARE = 0.1
"""Largest fraction of a training's time that frames take while the camera stands still, 0 to 1."""


JPEG_QUALITY = 90
"""JPEG quality of frames. viser's default of 75 shows blocks in smooth depths."""

VISER_RACE = "deque mutated during iteration"
"""Error of viser if a browser's task begins to wait for messages while another thread hands one over: viser sets an
asyncio.Event, which is not made for threads. The message is in its buffer, and leaves with the next one."""


class Shown(NamedTuple):
    """The frame that a browser shows.

    `camera` is the one it requested, `share` is the resolution as a fraction of the window's edges, `settings` and
    `version` are the states of the panel and of the scene, `at` is the time of completion and `seconds` the time it
    took, s.
    """

    camera: Camera
    share: float
    settings: int
    version: int
    at: float
    seconds: float


@dataclass
class Client:
    """A browser: viser's handle, its camera, the time of its last movement, s, and the frame that it shows."""

    handle: Any
    camera: Camera | None = None
    moved: float = 0.0
    share: float = 0.25
    """Resolution at which a frame takes `FRAME_TIME`, as a fraction of the window's edges. Adapted with each
    frame."""
    shown: Shown | None = None
    outlines: dict[int, Any] = field(default_factory=dict)
    """Handles of the cameras' outlines, by the index of the view."""

    def send(self, frame: Any) -> None:
        """Send a frame (H, W, 3) in 8 bits to the browser."""
        show = partial(self.handle.scene.set_background_image, frame, format="jpeg", jpeg_quality=JPEG_QUALITY)
        try:
            show()
        except RuntimeError as error:
            if str(error) != VISER_RACE:
                raise
            show()  # takes the first one along

    def share_due(self, now: float, settings: int, version: int) -> float:
        """Resolution of the next frame, as a fraction of the window's edges; 0 if no frame is due."""
        shown = self.shown
        if self.camera is None:
            return 0.0
        if shown is None or shown.camera is not self.camera or shown.settings != settings:
            return self.share
        if now - self.moved < STILL_AFTER:
            return 0.0
        if shown.share < 1:  # in steps, so that a movement waits for one of them at most
            return min(1.0, 2 * shown.share)
        stale = shown.version != version and now - shown.at > shown.seconds / TRAINING_SHARE
        return 1.0 if stale else 0.0

    def adapt(self, seconds: float) -> None:
        """Change the resolution of moving frames after one that took this time."""
        change = math.sqrt(FRAME_TIME / seconds)
        self.share = min(max(self.share * min(max(change, 0.5), 2.0), SMALLEST_SHARE), 1.0)
