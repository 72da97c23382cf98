"""The live viewer: frames by this package's own kernels, shown in a browser by viser.

One thread owns the device: the one that trains or, without training, the one that called `Viewer.hold`. viser's
threads only note what browsers ask for; `Viewer.draw` renders it when the owner calls it, between two iterations for
example. So neither the device nor the training needs a lock, and a training's bits do not depend on who is watching.
"""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.errors import DeviceError, InputError
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.reference.project import rotations
from clsplat.renderer import Renderer, download
from clsplat.show.camera_paths import Viewpoint

if TYPE_CHECKING:
    from clsplat.scene import View

MODES = ("render", "depth", "alpha", "count")
"""What is shown: colours, the expected depth, 1 - transmittance, the number of Gaussians drawn per pixel."""

FRAME_TIME = 0.1
"""Seconds that a frame may take while the camera moves: the resolution follows from it. Below 10 frames per second a
picture no longer seems to react to the hand (Card, Robertson and Mackinlay 1991, "immediate response")."""

STILL_AFTER = 0.25
"""Seconds without a movement after which frames are refined, up to the size of the window."""

SMALLEST_SHARE = 1 / 8
"""Of the window's edges: the coarsest a frame becomes while the camera moves."""

TRAINING_SHARE = 0.1
"""Of the time that frames nobody moved for may take from training."""

JPEG_QUALITY = 90
"""Of frames: 75, viser's default, shows blocks in smooth depths."""

FRUSTUM_SHARE = 0.025
"""Size of a camera's frustum, in mean distances of the cameras from what they look at: some fifty do not hide it."""

TEXT_EVERY = 0.25
"""Seconds between two updates of the panel's text."""


def client_camera(wxyz: Any, position: Any, fov: float, width: int, height: int) -> Camera:
    """The camera of a browser's window.

    Parameters
    ----------
    wxyz, position : (4,), (3,)
        Camera to world, OpenCV axes, as viser reports them.
    fov : float
        Vertical field of view, radians.
    width, height : int
        Size of the window in pixels.
    """
    viewmat = np.eye(4)
    quat = np.asarray(wxyz, dtype=np.float64)
    viewmat[:3, :3] = rotations(quat / np.linalg.norm(quat)).T
    viewmat[:3, 3] = -viewmat[:3, :3] @ np.asarray(position, dtype=np.float64)
    f = height / 2 / math.tan(fov / 2)
    return Camera(viewmat, f, f, width / 2, height / 2, width, height)


def wxyz_of(camera: Camera) -> NDArray[np.float64]:
    """Orientation of a camera, camera to world, as viser takes it, (4,)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(np.roll(Rotation.from_matrix(camera.viewmat[:3, :3].T).as_quat(), 1))


def whole_view(camera: Camera, aspect: float) -> float:
    """Vertical field of view, radians, in which a window of `aspect` (width over height) shows all of a camera's."""
    return 2 * math.atan(max(camera.height / camera.fy, camera.width / camera.fx / aspect) / 2)


def picture(renderer: Renderer, gaussians: Gaussians, camera: Camera, mode: str) -> tuple[NDArray[np.uint8], str]:
    """Render one frame.

    Parameters
    ----------
    renderer : Renderer
    gaussians : Gaussians
        On the host or on the renderer's device.
    camera : Camera
    mode : str
        One of `MODES`.

    Returns
    -------
    frame : (H, W, 3) uint8
    legend : str
        Meaning of its colours; empty for the render.
    """
    run = renderer.forward(gaussians, camera, depth=mode == "depth", gradients=False)
    if mode == "count":
        count = download(renderer.stages.count_pairs(run.splats, run.bins)[1])
        most = max(int(count.max()), 1)
        return _colored(count / most), f"dark 0, bright {most} Gaussians per pixel; mean {count.mean():.1f}"
    image, alpha = download(run.image.rgb), download(run.image.alpha)
    if mode == "alpha":
        return to_uint8(np.repeat(alpha[:, :, None], 3, axis=2)), "black transparent, white opaque"
    if mode == "depth":
        solid = alpha > 0.5
        if not solid.any():
            return np.zeros((*alpha.shape, 3), np.uint8), "nothing opaque in view"
        depth = image[:, :, 3] / np.where(solid, alpha, 1)
        near, far = np.percentile(depth[solid], [2, 98])
        frame = _colored(1 - (depth - near) / max(far - near, 1e-12))
        return np.where(solid[:, :, None], frame, 0).astype(np.uint8), f"bright {near:.3g}, dark {far:.3g} units away"
    return to_uint8(image), ""


def _colored(values: NDArray[Any]) -> NDArray[np.uint8]:
    from matplotlib import colormaps

    return np.asarray(colormaps["inferno"](np.clip(values, 0, 1), bytes=True)[:, :, :3])


class _Shown(NamedTuple):
    """What a browser shows: the camera and mode it asked for, at what share of its window's edges, the state of the
    scene, when it was done and the seconds it took."""

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
    """Of the window's edges, at which a frame takes `FRAME_TIME`: found while frames are drawn."""
    shown: _Shown | None = None


class Viewer:
    """A server that shows Gaussians in browsers.

    Parameters
    ----------
    renderer : Renderer
    start : Viewpoint
        Where browsers start. The mouse turns around the point on a camera's axis that is beside the focus.
    views : list of View
        Photos whose cameras are shown; a click on one goes there.
    host : str
        Address to listen at.
    port : int
        The first one tried; the next free one is taken.

    Raises
    ------
    InputError
        If the package viser is missing.
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
            import viser
        except ImportError as error:
            raise InputError(
                "viewer: expected the package viser, found none: pip install 'clsplat[viewer]'"
            ) from error

        self._renderer, self._focus = renderer, start.focus
        self._clients: dict[int, _Client] = {}
        self._asked = threading.Event()
        self._mode, self._version, self._paused = MODES[0], 0, False
        self._pause: Any = None
        self._facts, self._drawn, self._written = "", "", 0.0
        self._server = viser.ViserServer(host=host, port=port, label="clsplat", verbose=False)
        self.address = f"http://{host}:{self._server.get_port()}"
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        show = gui.add_dropdown("Show", MODES)
        if views:
            self._add_cameras(views)
        self._text = gui.add_markdown("")

        @show.on_update
        def _(_: Any) -> None:
            self._mode = show.value
            self._asked.set()

        self._server.scene.set_up_direction(tuple(start.up))
        first, initial = start.camera, self._server.initial_camera
        initial.position, initial.look_at = tuple(first.position), tuple(self._target(first))
        # Up without its part to the right looks as the photo does, and tilts the mouse's axis no more than needed.
        right = first.viewmat[0, :3]
        initial.up = tuple(start.up - (start.up @ right) * right)
        initial.fov = whole_view(first, first.width / first.height)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    def _add_cameras(self, views: "list[View]") -> None:
        """A frustum each, and a box to tick: those that stand nearest hide the scene."""
        parent = self._server.scene.add_frame("/cameras", show_axes=False)
        shown = self._server.gui.add_checkbox("Cameras", True)
        centres = np.array([view.camera.position for view in views])
        for view in views:
            self._frustum(view, FRUSTUM_SHARE * float(np.linalg.norm(centres - self._focus, axis=1).mean()))

        @shown.on_update
        def _(_: Any) -> None:
            parent.visible = shown.value

    def _target(self, camera: Camera) -> NDArray[np.float64]:
        """The point on a camera's axis beside the focus; or as far ahead as that is behind."""
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
        """Bring a browser to a camera."""
        with client.atomic():
            client.camera.position = camera.position
            client.camera.look_at = self._target(camera)
            client.camera.wxyz = wxyz_of(camera)
            client.camera.fov = whole_view(camera, client.camera.aspect)

    async def _connect(self, handle: Any) -> None:
        client = self._clients[handle.client_id] = _Client(handle)

        async def update(camera: Any) -> None:
            if min(camera.image_width, camera.image_height) > 0:
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
        """Render for every browser that waits for it, one frame each, on the thread that owns the device.

        Parameters
        ----------
        gaussians : Gaussians
            On the device or the host.

        Returns
        -------
        bool
            Whether there was anything to render.
        """
        due = [(c, self._share_due(c, time.perf_counter())) for c in list(self._clients.values())]
        due = [(client, share) for client, share in due if share]
        if due:
            gaussians = self._renderer.place(gaussians)
        for client, share in due:
            self._frame(client, share, gaussians)
        self._write()
        return bool(due)

    def _share_due(self, client: _Client, now: float) -> float:
        """The share of the window's edges at which the next frame is due; 0: none."""
        shown = client.shown
        if client.camera is None:
            return 0.0
        if shown is None or shown.camera is not client.camera or shown.mode != self._mode:
            return client.share
        if now - client.moved < STILL_AFTER:
            return 0.0
        if shown.share < 1:  # by steps, so that a movement never waits longer than for one of them
            return min(1.0, 2 * shown.share)
        stale = shown.version != self._version and now - shown.at > shown.seconds / TRAINING_SHARE
        return 1.0 if stale else 0.0

    def _frame(self, client: _Client, share: float, gaussians: Gaussians) -> None:
        camera, mode, started = client.camera, self._mode, time.perf_counter()
        assert camera is not None
        small = camera.resized(*(max(1, round(share * edge)) for edge in (camera.width, camera.height)))
        try:
            frame, legend = picture(self._renderer, gaussians, small, mode)
        except DeviceError as error:  # a training goes on without a picture
            frame, legend = np.zeros((1, 1, 3), np.uint8), str(error)
        if not any(c is client for c in self._clients.values()):
            return  # the browser has been closed in the meantime
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
        """Show Gaussians that do not change, until `until` says so or Ctrl-C is pressed.

        Parameters
        ----------
        gaussians : Gaussians
            On the device or the host.
        until : callable
            Asked some ten times a second.
        """
        gaussians = self._renderer.place(gaussians)
        self._version += 1
        while not until():
            self._asked.clear()
            if not self.draw(gaussians):
                self._asked.wait(STILL_AFTER / 2)

    def tell(self, facts: dict[str, str]) -> None:
        """What the panel says of the scene, below the modes: lines of name and value."""
        self._facts = "  \n".join(f"**{name}** {value}" for name, value in facts.items())
        self._write()

    def follow(self, gaussians: Gaussians, interrupted: Callable[[], bool]) -> None:
        """Between two iterations of training: draw what browsers ask for; wait while training is paused.

        Parameters
        ----------
        gaussians : Gaussians
            As they are now, on the device or the host.
        interrupted : callable
            Whether the user has asked for the end, which ends a pause as well.
        """
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
