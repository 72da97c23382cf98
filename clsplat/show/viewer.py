"""The live viewer: frames rendered by this package's kernels, shown in a browser by viser.

One thread owns the device: the one that trains or, without a training, the one that called `Viewer.hold`. The threads
of viser only store what browsers request. The owner renders it when it calls `Viewer.draw`, for example between two
iterations. Therefore neither the device nor the training needs a lock, and the result of a training does not depend
on the viewer.
"""

import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, default_near
from clsplat.errors import ClsplatError, InputError
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer, download
from clsplat.show.browser_cameras import client_camera, first_pose
from clsplat.show.camera_paths import Viewpoint
from clsplat.show.frames import Look, picture, splash
from clsplat.show.pacing import STILL_AFTER, VISER_RACE, Client, Shown
from clsplat.show.viewer_editing import Editing, Save
from clsplat.show.viewer_look import LookInputs
from clsplat.show.viewer_panel import Panel
from clsplat.show.viewer_photos import Photos
from clsplat.show.viewer_recording import Recording
from clsplat.show.viewer_statistics import Statistics
from clsplat.show.viewer_tasks import Task, Tasks

if TYPE_CHECKING:
    from clsplat.scene import View

TEXT_EVERY = 0.25
"""Time between two updates of the panel's text, s."""


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, ClsplatError) else f"{type(error).__name__}: {error}"


class Viewer:
    """Server that shows Gaussians in browsers. Until `show` is called, its page says what the viewer waits for.

    Parameters
    ----------
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

    def __init__(self, *, host: str = "127.0.0.1", port: int = 8080):
        inputs: dict[str, Callable[[Any], bool]] = {}
        try:
            from clsplat.show.viewer_server import start_server

            self._server, self.address = start_server(host, port, inputs)
        except ImportError as error:
            raise InputError(
                "cannot start the viewer: the package viser is missing; install it with pip install 'clsplat[viewer]'"
            ) from error
        self._renderer: Renderer | None = None
        self._clients: dict[int, Client] = {}
        self._joining = threading.Lock()  # a browser joins before `show` serves those that have joined, or after
        self._asked = threading.Event()
        self._tasks = Tasks()
        self._settings, self._version, self._paused = 0, 0, False
        self._near: float | None = None
        self._pause: Any = None
        self._look: LookInputs | None = None
        self._photos: Photos | None = None
        self._editing: Editing | None = None
        self._statistics: Statistics | None = None
        self._failed = False
        self._waits = "starting"
        self._facts, self._drawn, self._written = "", "", 0.0
        self._panel = Panel(self._server.gui, inputs)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._text = self._server.gui.add_markdown(f"**Waiting** {self._waits}")
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    def wait(self, reason: str) -> None:
        """Show what the viewer waits for, such as "recovering cameras", until there is a scene to draw."""
        self._waits = reason
        with self._harmless():
            if self._renderer is None:
                self._text.content = f"**Waiting** {reason}"
            for client in list(self._clients.values()):
                self._splash(client)

    def _splash(self, client: Client) -> None:
        if client.camera is not None and client.shown is None:
            frame = splash(self._waits, client.camera.width, client.camera.height)
            client.handle.scene.set_background_image(frame, format="png")

    def show(self, renderer: Renderer, start: Viewpoint, views: "list[View]") -> None:
        """Add what is shown of a scene, and move each browser to its first view.

        Parameters
        ----------
        renderer : Renderer
        start : Viewpoint
            The mouse turns the view around the point of the camera's axis nearest to the focus.
        views : list of View
            Photos, whose cameras are shown as outlines. A click on an outline moves the view to that camera.
        """
        tabs = self._tabs = self._server.gui.add_tab_group()
        with tabs.add_tab("View"):
            self._look = LookInputs(self._panel, renderer.background, self._touch)
        photos = None
        if views:
            with tabs.add_tab("Photos"):
                own = self._look.background, self._touch, self._later, self._look.tell_field
                photos = Photos(self._panel, views, start.focus, *own)
        with tabs.add_tab("Record"):
            self._recording = Recording(self._panel, start, self._pose_of, self._later, self._frame_of)
        pose, initial = first_pose(start), self._server.initial_camera
        self._server.scene.set_up_direction(tuple(start.up))
        initial.position, initial.look_at, initial.up, initial.fov = pose
        self._look.tell_field(pose.fov)
        with self._joining:
            self._renderer, self._photos = renderer, photos
            for client in list(self._clients.values()):
                with client.handle.atomic():
                    camera = client.handle.camera
                    camera.position, camera.look_at, camera.up_direction, camera.fov = pose
                if photos:
                    client.outlines = photos.outlines(client.handle)
        self._asked.set()

    def edit(self, gaussians: Gaussians, save: Save) -> None:
        """Let browsers edit Gaussians, which `hold` then shows.

        Parameters
        ----------
        gaussians : Gaussians
            On the host; not changed.
        save : callable
            Saves what is left, given as Gaussians, and returns a sentence about it.
        """
        with self._tabs.add_tab("Edit"):
            self._editing = Editing(self._panel, self._server.scene, gaussians, save, self._later)

        @self._server.scene.on_rect_select(modifier="shift")
        async def _(event: Any) -> None:
            client = self._clients.get(event.client_id)
            if self._editing is not None and client is not None and client.camera is not None:
                self._editing.select(client.camera, event.screen_min, event.screen_max)

    def _touch(self) -> None:
        """Have every browser's frame drawn again, after a change of the panel."""
        self._settings += 1
        self._asked.set()

    def _later(self, task: Task) -> None:
        """Let the thread that owns the device run a task."""
        self._tasks.add(task)
        self._asked.set()

    async def _connect(self, handle: Any) -> None:
        client = Client(handle)

        async def update(camera: Any) -> None:
            client.camera = client_camera(
                camera.wxyz, camera.position, camera.fov, camera.image_width, camera.image_height
            )
            client.moved = time.perf_counter()
            if self._renderer is None:
                self._splash(client)
            self._asked.set()

        handle.camera.on_update(update)
        await update(handle.camera)
        with self._joining:
            if self._photos:
                client.outlines = self._photos.outlines(handle)
            self._clients[handle.client_id] = client  # complete, for the thread that draws

    async def _disconnect(self, handle: Any) -> None:
        self._clients.pop(handle.client_id, None)

    def _pose_of(self, client_id: int) -> Camera | None:
        client = self._clients.get(client_id)
        return None if client is None else client.camera

    def draw(self, gaussians: Gaussians) -> bool:
        """Render one frame for each browser that waits for one. Call it on the thread that owns the device.

        Parameters
        ----------
        gaussians : Gaussians
            On the device or the host.

        Returns
        -------
        bool
            True if a frame was rendered, or another task is not done.
        """
        if self._renderer is None:
            return False
        now, clients = time.perf_counter(), list(self._clients.values())
        due = [(client, client.share_due(now, self._settings, self._version)) for client in clients]
        due = [(client, share) for client, share in due if share]
        with self._harmless():
            gaussians = self._renderer.place(gaussians) if due or self._tasks.busy else gaussians
            for client, share in due:
                self._frame(client, share, gaussians)
            with self._noted():
                self._tasks.run(gaussians)
            self._write()
        return bool(due) or self._tasks.busy

    @contextmanager
    def _noted(self) -> Iterator[None]:
        """Show browsers an error in the block, such as a full disk: the user reads it and tries again."""
        try:
            yield
        except Exception as error:
            for client in list(self._clients.values()):
                client.handle.add_notification("clsplat", _reason(error), auto_close_seconds=8)

    @contextmanager
    def _harmless(self) -> Iterator[None]:
        """Turn the first error in the block into a warning, and ignore the others: none may end a training."""
        try:
            yield
        except Exception as error:
            if not self._failed and str(error) != VISER_RACE:
                self._failed = True
                warnings.warn(f"the viewer failed: {_reason(error)}; its frames may be missing or old", stacklevel=3)

    def _frame_of(self, camera: Camera, gaussians: Gaussians) -> tuple[NDArray[np.uint8], str]:
        """Render a frame with the settings of the panel; return it with its legend."""
        assert self._renderer is not None
        if self._near is None and len(gaussians):  # once: the means may be on the device
            self._near = default_near(download(gaussians.means))
        look = self._look.look() if self._look else Look()
        return picture(self._renderer, gaussians, replace(camera, near=self._near), look)

    def _frame(self, client: Client, share: float, gaussians: Gaussians) -> None:
        camera, settings, started = client.camera, self._settings, time.perf_counter()
        assert camera is not None
        small = camera.resized(*(max(1, round(share * edge)) for edge in (camera.width, camera.height)))
        try:
            frame, legend = self._frame_of(small, gaussians)
            if self._photos:
                frame = self._photos.compared(frame, small)
        except Exception as error:  # of any type: it must not end a training
            frame, legend = np.zeros((1, 1, 3), np.uint8), _reason(error)
        if not any(c is client for c in list(self._clients.values())):
            return  # the browser was closed in the meantime
        with self._harmless():
            client.send(frame)
            if self._photos:
                self._photos.fade(client.outlines, camera)
        now = time.perf_counter()
        if share == client.share:
            client.adapt(now - started)
        client.shown = Shown(camera, share, settings, self._version, now, now - started)
        self._drawn = f"{small.width} x {small.height} in {1000 * (now - started):.0f} ms  \n{legend}"

    def _write(self, *, at_once: bool = False) -> None:
        text, now = f"{self._facts}  \n{self._drawn}", time.perf_counter()
        if text != self._text.content and (at_once or now - self._written > TEXT_EVERY):
            self._text.content, self._written = text, now

    def hold(self, gaussians: Gaussians, until: Callable[[], bool] = lambda: False) -> None:
        """Show Gaussians that only browsers edit, until `until` returns True or Ctrl-C.

        Parameters
        ----------
        gaussians : Gaussians
            On the device or the host.
        until : callable
            Called about ten times a second.
        """
        assert self._renderer is not None, "show comes first"
        gaussians = self._renderer.place(gaussians)
        self._version += 1
        while not until():
            self._asked.clear()
            with self._harmless(), self._noted():
                if self._editing is not None and (edited := self._editing.changed()) is not None:
                    gaussians = self._renderer.place(edited)
                    self._version += 1
                    self._touch()
            if not self.draw(gaussians):
                self._asked.wait(STILL_AFTER / 2)

    def tell(self, facts: dict[str, str]) -> None:
        """Set the facts about the scene that the panel shows, by name."""
        self._facts = "  \n".join(f"**{name}** {value}" for name, value in facts.items())
        with self._harmless():
            self._write()

    def record(self, iteration: int, count: int, psnr: float | None = None) -> None:
        """Add the state of a training to the curves of the panel."""
        with self._harmless():
            if self._statistics is None and self._renderer is not None:
                with self._tabs.add_tab("Training"):
                    self._statistics = Statistics(self._server.gui)
            if self._statistics is not None:
                self._statistics.add(iteration, count, psnr)

    def follow(self, gaussians: Gaussians, interrupted: Callable[[], bool]) -> None:
        """Draw the frames that browsers request, and wait while the training is paused.

        A training calls this between two iterations. An error of the viewer of any type becomes a warning.

        Parameters
        ----------
        gaussians : Gaussians
            Current state, on the device or the host.
        interrupted : callable
            Returns True when the user has interrupted the training, which also ends a pause.
        """
        with self._harmless():
            if self._pause is None:
                self._pause = self._panel.button("Pause training", self._toggle)
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
