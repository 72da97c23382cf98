"""The web server of the viewer: viser's, with a check of each connection and each message.

On its own, viser accepts connections from the pages of any site, and its handlers trust the messages: one can open a
public tunnel, others fill the memory or replace attributes of Python objects. Therefore this module admits only the
viewer's own page, and only the four kinds of messages that this page sends. A change of the panel must name an input
and a value that the input can have.
"""

import contextlib
import io
import ipaddress
import logging
import secrets
import socket
import threading
import warnings
from collections.abc import Iterator
from dataclasses import replace
from http import HTTPStatus
from typing import Any, Literal
from urllib.parse import urlsplit

import msgspec
import numpy as np
import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection, serve
from websockets.http11 import Request, Response

from clsplat.errors import InputError
from clsplat.show.browser_cameras import client_camera
from clsplat.show.viewer_panel import Inputs

LARGEST_MESSAGE = 2**16
"""Size of the largest message that is read, bytes. A camera takes about 300, and a click names a photo, whose file
name can have 255 characters. viser's own limit, for uploads that this viewer does not have, is 50 MiB."""

_LOGGER = logging.getLogger(__name__)
"""Receives what websockets says about broken connections. With its handler, nothing is printed: tracebacks would end
up in the progress bar of a training."""
_LOGGER.addHandler(logging.NullHandler())

_PATCHING = threading.Lock()
"""Held while `serve` of websockets is replaced."""

Vector = tuple[float, float, float]


class _CameraMessage(msgspec.Struct, tag="ViewerCameraMessage", forbid_unknown_fields=True):
    wxyz: tuple[float, float, float, float]
    position: Vector
    fov: float
    near: float
    far: float
    image_height: int
    image_width: int
    look_at: Vector
    up_direction: Vector

    def __post_init__(self) -> None:
        client_camera(self.wxyz, self.position, self.fov, self.image_width, self.image_height)
        axes = np.array([self.look_at, self.up_direction])
        if not np.isfinite(axes).all() or not axes[1].any() or self.look_at == self.position:
            raise InputError(f"camera: expected a target and an up direction, found {axes.tolist()}")


class _InputMessage(msgspec.Struct, tag="GuiUpdateMessage", forbid_unknown_fields=True):
    uuid: str
    updates: dict[Literal["value"], str | bool | int | float | Vector]
    """viser sets any attribute that a message names; those of the panel only change their values."""


class _ClickMessage(msgspec.Struct, tag="SceneNodeClickMessage", forbid_unknown_fields=True):
    name: str
    instance_index: int | None
    ray_origin: Vector
    ray_direction: Vector
    screen_pos: tuple[float, float]
    modifier: str | None
    owner: str = ""


class _RectangleMessage(msgspec.Struct, tag="ScenePointerMessage", forbid_unknown_fields=True):
    event_type: Literal["rect-select"]
    ray_origin: Vector | None
    ray_direction: Vector | None
    screen_pos: tuple[tuple[float, float], tuple[float, float]]
    modifier: str | None

    def __post_init__(self) -> None:
        if not np.isfinite(self.screen_pos).all():
            raise InputError(f"rectangle: expected finite corners, found {self.screen_pos}")


_DECODER = msgspec.msgpack.Decoder(_CameraMessage | _InputMessage | _ClickMessage | _RectangleMessage)


def acceptable(message: str | bytes, inputs: Inputs) -> bool:
    """Whether a message is one that the viewer's page sends, with a usable camera or a possible value."""
    if isinstance(message, str):
        return False
    try:
        found = _DECODER.decode(message)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError):
        return False
    if not isinstance(found, _InputMessage):
        return True
    return found.uuid in inputs and all(inputs[found.uuid](value) for value in found.updates.values())


def _connection(inputs: Inputs) -> type[ServerConnection]:
    """Class of connections that ignore all other messages."""

    class Connection(ServerConnection):
        async def recv(self, decode: bool | None = None) -> Any:
            while not acceptable(message := await super().recv(decode), inputs):
                pass
            return message

    return Connection


def is_loopback(host: str | None) -> bool:
    """Whether only this machine reaches `host`, a name or an address without a port."""
    if host is None or host == "localhost":
        return host is not None
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_own_page(headers: Headers) -> bool:
    """Whether a page of this server, opened on this machine, requests a connection.

    Browsers tell the page's address in `Origin` and the requested address in `Host`. The two are equal for a page of
    this server, also if ssh forwards another port to it. The name must be one of this machine, because another site
    can have its own name resolved to 127.0.0.1 (DNS rebinding), which makes the two equal as well.
    """
    host = headers.get("Host", "")
    same = headers.get("Origin") in (f"http://{host}", f"https://{host}")
    return same and is_loopback(urlsplit(f"//{host}").hostname)


def _checked(process_request: Any, token: str | None) -> Any:
    """Hook `process_request` of websockets that refuses requests that are not admitted, and passes on the others."""

    def check(connection: ServerConnection, request: Request) -> Response | Any:
        if token is not None:
            first, _, rest = request.path.partition("?")[0].lstrip("/").partition("/")
            if not secrets.compare_digest(first.encode(), token.encode()):
                return connection.respond(HTTPStatus.FORBIDDEN, "Open the whole address that clsplat has printed.\n")
            request = replace(request, path=f"/{rest}")
        elif "Upgrade" in request.headers and not is_own_page(request.headers):
            return connection.respond(
                HTTPStatus.FORBIDDEN, "Open the viewer by the address 127.0.0.1 or localhost.\n"
            )
        return process_request(connection, request)

    return check


@contextlib.contextmanager
def _checking(token: str | None, inputs: Inputs) -> Iterator[list[bool]]:
    """Add the checks to a server that is started in the block; the list is empty if none was.

    viser 1.1 has no option for them: it passes its own arguments to `websockets.asyncio.server.serve`, and no object
    that it keeps leads to the server. So this function is replaced while viser starts.
    """
    started: list[bool] = []

    def checked_serve(handler: Any, *address: Any, process_request: Any, **options: Any) -> serve:
        started.append(True)
        checks = {"process_request": _checked(process_request, token), "create_connection": _connection(inputs)}
        return serve(handler, *address, **options | checks | {"max_size": LARGEST_MESSAGE, "logger": _LOGGER})

    with _PATCHING:
        websockets.asyncio.server.serve = checked_serve  # type: ignore[assignment,misc]
        try:
            yield started
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]


def start_server(host: str, port: int, inputs: Inputs) -> tuple[Any, str]:
    """Start viser's server with the checks.

    Parameters
    ----------
    host : str
        Address to listen on. If other machines can reach it, the path of the returned address is a random token, and
        only requests with this token are answered.
    port : int
        First port to try. If it is taken, the next free one is used.
    inputs : dict
        Those of the panel. The caller adds them as it makes them.

    Returns
    -------
    server : viser.ViserServer
    address : str
        The address for the browser.

    Raises
    ------
    InputError
        If the machine cannot listen on `host`, or this version of viser starts its server in an unknown way.
    ImportError
        If viser is not installed.
    """
    import viser

    _check_host(host)
    token = None if is_loopback(host) else secrets.token_urlsafe()
    # A browser may leave while its frame is drawn. viser warns of the frame, which nobody misses.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
    # viser prints its own address, without the token.
    with _checking(token, inputs) as started, contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label="clsplat", verbose=False)
    if not started:
        server.stop()
        raise InputError(
            f"viser: expected a version whose connections can be checked, such as 1.1, found {viser.__version__}; "
            "pip install 'viser~=1.1.0'"
        )
    name = socket.gethostname() if host in ("", "0.0.0.0", "::") else host
    name = f"[{name}]" if ":" in name else name
    return server, f"http://{name}:{server.get_port()}" + (f"/{token}" if token else "")


def _check_host(host: str) -> None:
    """Raise an InputError if no port of `host` can be listened on: viser would wait for it forever."""
    try:
        family, *_, address = socket.getaddrinfo(host or None, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind(address)
    except OSError as error:
        raise InputError(
            f"--host: cannot listen on {host!r}: {error.strerror}; expected an address of this machine"
        ) from error
