"""Clients of the viewer without a browser: messages as its page sends them, and a thread that holds connections."""

import asyncio
import socket
import threading
from collections.abc import Coroutine
from typing import Any

import msgspec
import viser
from browser import PATIENCE

PROTOCOL = f"viser-v{viser.__version__}"


def camera_message(**changes: Any) -> bytes:
    """The message with which the viewer's page tells its camera; `changes` replaces fields."""
    pose = {"wxyz": [1, 0, 0, 0], "position": [0, 0, -3.5], "look_at": [0, 0, 0], "up_direction": [0, -1, 0]}
    window = {"fov": 1.2, "near": 0.1, "far": 1000, "image_height": 48, "image_width": 64}
    return msgspec.msgpack.encode({"type": "ViewerCameraMessage", **pose, **window, **changes})


def own(address: str, **options: Any) -> dict[str, Any]:
    """Arguments of websockets' `connect` for a connection as the viewer's page requests it."""
    host = address.removeprefix("http://").split("/")[0]
    defaults = {"origin": f"http://{host}", "subprotocols": [PROTOCOL], "compression": None, "proxy": None}
    return {"uri": address.replace("http", "ws", 1), **defaults, **options}


class Swarm:
    """Connections that are held by one thread, however many they are."""

    def __init__(self, address: str):
        self.address = address
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)

    def __enter__(self) -> "Swarm":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def run(self, work: Coroutine[Any, Any, Any]) -> Any:
        """The result of a coroutine, run by the thread."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(PATIENCE)

    def connect(self, count: int) -> list[Any]:
        """That many connections."""
        from websockets.asyncio.client import connect

        async def all_of_them() -> list[Any]:
            return await asyncio.gather(*(connect(**own(self.address)) for _ in range(count)))

        return self.run(all_of_them())

    def send(self, clients: list[Any], *messages: bytes | str) -> None:
        """Send messages by each connection, in their order."""

        async def each(client: Any) -> None:
            for message in messages:
                await client.send(message)

        async def all_of_them() -> None:
            await asyncio.gather(*map(each, clients))

        self.run(all_of_them())

    def close(self, clients: list[Any]) -> None:
        """Close connections as browsers do."""

        async def all_of_them() -> None:
            await asyncio.gather(*(client.close() for client in clients))

        self.run(all_of_them())

    def abort(self, clients: list[Any]) -> None:
        """Cut connections without a word."""

        async def all_of_them() -> None:
            for client in clients:
                client.transport.abort()

        self.run(all_of_them())


def silent_client(address: str) -> socket.socket:
    """A connection, opened by hand, that reads nothing after the handshake, and whose buffers are small."""
    host, port = address.removeprefix("http://").split(":")
    result = socket.socket()
    result.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    result.settimeout(PATIENCE)
    result.connect((host, int(port)))
    headers = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    headers += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", f"Sec-WebSocket-Protocol: {PROTOCOL}"]
    headers += [f"Host: {host}:{port}", f"Origin: {address}"]
    result.sendall("\r\n".join(["GET / HTTP/1.1", *headers, "", ""]).encode())
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        answer += result.recv(1)
    assert answer.startswith(b"HTTP/1.1 101 ")
    return result


def frame(message: bytes) -> bytes:
    """A message as `silent_client` must send it."""
    from websockets.frames import Frame, Opcode

    return Frame(Opcode.BINARY, message).serialize(mask=True)
