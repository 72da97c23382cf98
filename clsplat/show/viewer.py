"""The live viewer: frames rendered by this package's kernels, shown in a browser by viser.

One thread owns the device: the one that trains or, without a training, the one that called `Viewer.hold`. The threads
of viser only store what browsers request. The owner renders it when it calls `Viewer.draw`, for example between two
iterations. Therefore neither the device nor the training needs a lock, and the result of a training does not depend
on the viewer.
"""

import math
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, default_near
from clsplat.errors import ClsplatError, InputError
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer, download
from clsplat.show.browser_cameras import client_camera, whole_view, wxyz_of
from clsplat.show.camera_paths import Viewpoint
from clsplat.show.frames import MODES, picture

if TYPE_CHECKING:
    from clsplat.scene import View

FRAME_TIME = 0.1
"""Time of a frame while the camera moves, s. The resolution is chosen to keep it. Below 10 frames per second a
picture no longer seems to react immediately (Card, Robertson and Mackinlay 1991, "immediate response")."""

STILL_AFTER = 0.25
"""Time without a movement after which frames are refined, up to the size of the window, s."""

SMALLEST_SHARE = 1 / 8
"""Smallest resolution of a frame while the camera moves, as a fraction of the window's edges."""

TRAINING_SHARE = 0.1
"""Largest fraction of a training's time that frames take while the camera stands still, 0 to 1."""

JPEG_QUALITY = 90
"""JPEG quality of frames. viser's default of 75 shows blocks in smooth depths."""

FRUSTUM_SHARE = 0.025
"""Size of a camera's frustum, as a fraction of the cameras' mean distance from the focus. Some fifty frusta of this
size do not hide the scene."""

TEXT_EVERY = 0.25
"""Time between two updates of the panel's text, s."""


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, ClsplatError) else f"{type(error).__name__}: {error}"


class _Shown(NamedTuple):
    """The frame that a browser shows.

    `camera` and `mode` are those it requested, `share` is the resolution as a fraction of the window's edges,
    `version` the state of the scene, `at` the time of completion, s, and `seconds` the time it took.
    """

    camera: Camera
    mode: str
    share: float
    version: int
    at: float
    seconds: float


@dataclass
class _Client:
    handle: Any
    camera: Camera | None = None
    moved: float = 0.0
    share: float = 0.25
    """Resolution at which a frame takes `FRAME_TIME`, as a fraction of the window's edges. Adapted with each
    frame."""
    shown: _Shown | None = None


class Viewer:
    """A server that shows Gaussians in browsers.

    Parameters
    ----------
    renderer : Renderer
    start : Viewpoint
        First view of each browser. The mouse turns the view around the point of the camera's axis nearest to the
        focus.
    views : list of View
        Photos whose cameras are shown as frusta. A click on a frustum moves the view to that camera.
    host : str
        Address that the server listens on. If other machines can reach it, only the whole `address`, with its random
        token, opens the viewer.
    port : int
        First port to try. If it is taken, the next free one is used.

    Attributes
    ----------
    address : str
        What to open in the browser.

    Raises
    ------
    InputError
        If the package viser is not installed, or the machine cannot listen on `host`.
    """

    def __init__(
        self,
        renderer: Renderer,
        start: Viewpoint,
        views: "list[View]",
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
    ):
        try:
            from clsplat.show.viewer_server import start_server

            self._server, self.address = start_server(host, port)
        except ImportError as error:
            raise InputError(
                "cannot start the viewer: the package viser is missing; install it with pip install 'clsplat[viewer]'"
            ) from error

        self._renderer, self._focus = renderer, start.focus
        self._clients: dict[int, _Client] = {}
        self._asked = threading.Event()
        self._mode, self._version, self._paused = MODES[0], 0, False
        self._near: float | None = None
        self._pause: Any = None
        self._failed = False
        self._facts, self._drawn, self._written = "", "", 0.0
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        show = gui.add_dropdown("Show", MODES)
        if views:
            self._add_cameras(views)
        self._text = gui.add_markdown("")

        @show.on_update
        def _(_: Any) -> None:
            if show.value in MODES:  # a page can send any text
                self._mode = show.value
                self._asked.set()

        self._server.scene.set_up_direction(tuple(start.up))
        first, initial = start.camera, self._server.initial_camera
        initial.position, initial.look_at = tuple(first.position), tuple(self._target(first))
        # Without its component to the right, the up vector reproduces the photo and tilts the mouse's axis least.
        right = first.viewmat[0, :3]
        initial.up = tuple(start.up - (start.up @ right) * right)
        initial.fov = whole_view(first, first.width / first.height)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    def _add_cameras(self, views: "list[View]") -> None:
        """Add a frustum per camera, and a checkbox to hide them: near ones can cover the scene."""
        parent = self._server.scene.add_frame("/cameras", show_axes=False)
        shown = self._server.gui.add_checkbox("Cameras", True)
        centres = np.array([view.camera.position for view in views])
        for view in views:
            self._frustum(view, FRUSTUM_SHARE * float(np.linalg.norm(centres - self._focus, axis=1).mean()))

        @shown.on_update
        def _(_: Any) -> None:
            parent.visible = shown.value

    def _target(self, camera: Camera) -> NDArray[np.float64]:
        """The point of a camera's axis nearest to the focus, mirrored to the front if it is behind the camera."""
        axis = camera.viewmat[2, :3]
        distance = abs(float((self._focus - camera.position) @ axis))
        return np.asarray(camera.position + max(distance, 1e-3) * axis)

    def _frustum(self, view: "View", size: float) -> None:
        camera = view.camera
        frustum = self._server.scene.add_camera_frustum(
            f"/cameras/{view.name}",
            fov=2 * math.atan(camera.height / camera.fy / 2),
            aspect=camera.width / camera.fx * camera.fy / camera.height,
            scale=size,
            thickness=1.5,
            thickness_units="screen",
            color=(255, 160, 0),
            wxyz=wxyz_of(camera),
            position=camera.position,
        )

        @frustum.on_click
        async def _(event: Any) -> None:
            self._jump(event.client, camera)

    def _jump(self, client: Any, camera: Camera) -> None:
        """Move a browser's view to a camera."""
        with client.atomic():
            client.camera.position = camera.position
            client.camera.look_at = self._target(camera)
            client.camera.wxyz = wxyz_of(camera)
            client.camera.fov = whole_view(camera, client.camera.aspect)

    async def _connect(self, handle: Any) -> None:
        client = self._clients[handle.client_id] = _Client(handle)

        async def update(camera: Any) -> None:
            client.camera = client_camera(
                camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height
            )
            client.moved = time.perf_counter()
            self._asked.set()

        handle.camera.on_update(update)
        await update(handle.camera)

    async def _disconnect(self, handle: Any) -> None:
        self._clients.pop(handle.client_id, None)

    def draw(self, gaussians: Gaussians) -> bool:
        """Render one frame for each browser that waits for one. Call it on the thread that owns the device.

        Parameters
        ----------
        gaussians : Gaussians
            On the device or the host.

        Returns
        -------
        bool
            True if a frame was rendered.
        """
        due = [(c, self._share_due(c, time.perf_counter())) for c in list(self._clients.values())]
        due = [(client, share) for client, share in due if share]
        with self._harmless():
            gaussians = self._renderer.place(gaussians) if due else gaussians
            for client, share in due:
                self._frame(client, share, gaussians)
            self._write()
        return bool(due)

    @contextmanager
    def _harmless(self) -> Iterator[None]:
        """Turn the first error in the block into a warning, and ignore the others: none may end a training."""
        try:
            yield
        except Exception as error:
            if not self._failed:
                self._failed = True
                warnings.warn(f"the viewer failed: {_reason(error)}; its frames may be missing or old", stacklevel=3)

    def _share_due(self, client: _Client, now: float) -> float:
        """Resolution of the next frame, as a fraction of the window's edges; 0 if no frame is due."""
        shown = client.shown
        if client.camera is None:
            return 0.0
        if shown is None or shown.camera is not client.camera or shown.mode != self._mode:
            return client.share
        if now - client.moved < STILL_AFTER:
            return 0.0
        if shown.share < 1:  # in steps, so that a movement waits for one of them at most
            return min(1.0, 2 * shown.share)
        stale = shown.version != self._version and now - shown.at > shown.seconds / TRAINING_SHARE
        return 1.0 if stale else 0.0

    def _frame(self, client: _Client, share: float, gaussians: Gaussians) -> None:
        camera, mode, started = client.camera, self._mode, time.perf_counter()
        assert camera is not None
        small = camera.resized(*(max(1, round(share * edge)) for edge in (camera.width, camera.height)))
        try:
            if self._near is None and len(gaussians):  # once: the means may be on the device
                self._near = default_near(download(gaussians.means))
            small = replace(small, near=self._near)
            frame, legend = picture(self._renderer, gaussians, small, mode)
        except Exception as error:  # of any type: it must not end a training
            frame, legend = np.zeros((1, 1, 3), np.uint8), _reason(error)
        if not any(c is client for c in list(self._clients.values())):
            return  # the browser was closed in the meantime
        with self._harmless():
            client.handle.scene.set_background_image(frame, format="jpeg", jpeg_quality=JPEG_QUALITY)
        now = time.perf_counter()
        if share == client.share:
            change = math.sqrt(FRAME_TIME / (now - started))
            client.share = min(max(client.share * min(max(change, 0.5), 2.0), SMALLEST_SHARE), 1.0)
        client.shown = _Shown(camera, mode, share, self._version, now, now - started)
        self._drawn = f"{small.width} x {small.height} in {1000 * (now - started):.0f} ms  \n{legend}"

    def _write(self, *, at_once: bool = False) -> None:
        text, now = f"{self._facts}  \n{self._drawn}", time.perf_counter()
        if text != self._text.content and (at_once or now - self._written > TEXT_EVERY):
            self._text.content, self._written = text, now

    def hold(self, gaussians: Gaussians, until: Callable[[], bool] = lambda: False) -> None:
        """Show Gaussians that do not change, until `until` returns True or Ctrl-C is pressed.

        Parameters
        ----------
        gaussians : Gaussians
            On the device or the host.
        until : callable
            Called about ten times a second.
        """
        gaussians = self._renderer.place(gaussians)
        self._version += 1
        while not until():
            self._asked.clear()
            if not self.draw(gaussians):
                self._asked.wait(STILL_AFTER / 2)

    def tell(self, facts: dict[str, str]) -> None:
        """Set the facts about the scene that the panel shows below the modes, by name."""
        self._facts = "  \n".join(f"**{name}** {value}" for name, value in facts.items())
        with self._harmless():
            self._write()

    def follow(self, gaussians: Gaussians, interrupted: Callable[[], bool]) -> None:
        """Draw the frames that browsers request, and wait while the training is paused.

        A training calls this between two iterations. An error of the viewer becomes a warning, whatever its type.

        Parameters
        ----------
        gaussians : Gaussians
            Current state, on the device or the host.
        interrupted : callable
            Returns True when the user has interrupted the training, which also ends a pause.
        """
        with self._harmless():
            if self._pause is None:
                self._pause = self._server.gui.add_button("Pause training")
                self._pause.on_click(self._toggle)
            self._version += 1
            self.draw(gaussians)
            if self._paused:
                self.hold(gaussians, lambda: interrupted() or not self._paused)

    def _toggle(self, _: Any) -> None:
        self._paused = not self._paused
        self._pause.label = "Resume training" if self._paused else "Pause training"
        self._asked.set()

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
