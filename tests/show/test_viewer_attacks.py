"""Trainings beside a real server that many, hostile and hasty clients use: the same bits, and nothing left behind."""

import asyncio
import threading
import warnings

import numpy as np
import pytest
from browser import wait_for
from small_scenes import cameras, small_training

pytest.importorskip("viser", reason="viser, the extra `viewer`, is missing")

import msgspec
from websocket_clients import Swarm, camera_message, frame, silent_client

from clsplat.show.viewer_server import LARGEST_MESSAGE

ITERATIONS = 12

EXECUTOR_THREADS = 32
"""Threads that viser keeps for callbacks, at most."""


@pytest.fixture(scope="module")
def alone(device, tmp_path_factory):
    """The Gaussians of the training without a viewer."""
    return small_training(device, tmp_path_factory.mktemp("alone")).arrays()


@pytest.fixture
def swarm(viewer):
    """Clients of the viewer, and a check that nothing of them is left when they are gone."""
    before = threading.active_count()
    with Swarm(viewer.address) as result:
        yield result
        wait_for(lambda: not left(viewer), "the end of all connections")
        assert threading.active_count() <= before + 1 + EXECUTOR_THREADS


def left(viewer):
    """What the viewer and viser keep for each client."""
    server = viewer._server._websock_server
    cursors = server._broadcast_buffer.generator_cursors
    kept = (viewer._clients, viewer._server.get_clients(), server._client_state_from_id, server._live_connections)
    return [*kept, cursors] if any(map(len, (*kept, cursors))) else []


def trained_beside(viewer, device, out, alone, act):
    """Train with the viewer; `act` runs after each iteration, before its frames. Compare the bits."""

    def progress(record):
        act(record["iteration"])
        viewer.tell({"Iteration": str(record["iteration"])})
        viewer.follow(record["gaussians"], lambda: False)

    for name, array in small_training(device, out, progress).arrays().items():
        np.testing.assert_array_equal(array, alone[name], err_msg=name)


def moved(iteration):
    """A camera message that differs in each iteration."""
    return camera_message(position=[0.1 * iteration, 0, -3.5])


def settled(viewer):
    """Wait until the server has handled what has arrived."""
    asyncio.run_coroutine_threadsafe(asyncio.sleep(0), viewer._server.get_event_loop()).result()


def test_fifty_clients_at_once(viewer, device, tmp_path, alone, swarm):
    clients = []

    def act(iteration):
        if iteration == 1:
            clients.extend(swarm.connect(50))
        if iteration <= 3:
            swarm.send(clients, moved(iteration))
            wait_for(lambda: len(viewer._clients) == 50, "50 clients")
        if iteration == 4:
            assert all(client.shown is not None for client in viewer._clients.values())
            swarm.close(clients)

    trained_beside(viewer, device, tmp_path, alone, act)


def test_clients_that_come_and_go(viewer, device, tmp_path, alone, swarm):
    """They leave with and without a farewell, before and after their first camera, and with frames under way."""
    staying = []

    def act(iteration):
        old, new = staying[:], swarm.connect(6)
        swarm.send(new[:4], moved(iteration))
        swarm.close(new[0:1] + new[4:5])
        swarm.abort(new[1:2] + new[5:6])
        staying[:] = new[2:4]
        (swarm.close if iteration % 2 else swarm.abort)(old)
        wait_for(lambda: len(viewer._clients) >= 1, "a client that stays")

    trained_beside(viewer, device, tmp_path, alone, act)
    swarm.abort(staying)


def nonsense(rng):
    """Messages that no page of the viewer sends."""
    yield "text"
    yield from (rng.bytes(int(size)) for size in rng.integers(0, 2000, 20))
    good = msgspec.msgpack.decode(camera_message())
    wrong = [None, "x", -1, 2**63, float("nan"), float("inf"), [], [1] * 5, {}, {"a": 1}, True, 1e300, b"x"]
    for name in good:
        yield from (msgspec.msgpack.encode({**good, name: value}) for value in wrong)
    for kind in ("ShareUrlRequest", "GuiFormDirtyMessage", "FileTransferStartUpload", "GetRenderResponseMessage", ""):
        yield msgspec.msgpack.encode({"type": kind, "uuid": "x"})
    yield msgspec.msgpack.encode({"type": "SceneNodeClickMessage", "name": "/cameras/0.png"})
    yield msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "1", "updates": {"sync_cb": 1}})
    yield b"\x91" * 10_000
    yield b"\xdf\xff\xff\xff\xff"  # a map that promises 2^32 - 1 entries


def test_messages_of_nonsense(viewer, device, tmp_path, alone, swarm):
    rng = np.random.default_rng(4)
    clients = swarm.connect(2)

    def act(iteration):
        if iteration > 3:
            return
        swarm.send(clients[:1], *nonsense(rng), camera_message(image_width=100_000, image_height=100_000))
        swarm.send(clients, moved(iteration))
        expected = [0.1 * iteration, 0, -3.5]

        def arrived():
            cameras = [client.camera for client in list(viewer._clients.values())]
            return len(cameras) == 2 and all(np.allclose(camera.position, expected) for camera in cameras)

        wait_for(arrived, "the cameras after the nonsense")
        huge = swarm.connect(1)
        swarm.send(huge, bytes(20 * LARGEST_MESSAGE))
        swarm.run(huge[0].wait_closed())
        assert huge[0].close_code == 1009

    trained_beside(viewer, device, tmp_path, alone, act)
    swarm.close(clients)


def test_a_client_that_never_reads(viewer, device, tmp_path, alone, swarm):
    client = silent_client(viewer.address)
    noise = np.random.default_rng(0).integers(0, 255, (1200, 1600, 3), dtype=np.uint8)

    def act(iteration):
        client.sendall(frame(moved(iteration)))
        wait_for(lambda: viewer._clients, "the client")
        if iteration == 1:
            (handle,) = (kept.handle for kept in viewer._clients.values())
            (connection,) = viewer._server._websock_server._live_connections.values()
            for _ in range(8):
                handle.scene.set_background_image(noise, format="jpeg", jpeg_quality=90)
                settled(viewer)
            wait_for(lambda: connection.transport.get_write_buffer_size() > 0, "a connection that takes no more")

    trained_beside(viewer, device, tmp_path, alone, act)
    (kept,) = viewer._clients.values()
    pending = kept.handle._websock_connection.get_message_buffer().message_from_id
    updates = len(kept.outlines)
    assert len(pending) <= 1 + updates, "only the last frame and the last state of each outline wait for the client"
    client.close()


class TestErrors:
    """Whatever fails in the viewer, the training goes on."""

    @pytest.fixture(
        params=[MemoryError, RuntimeError, KeyError, ZeroDivisionError, RecursionError], ids=lambda e: e.__name__
    )
    def failing(self, request):
        def fails(*_, **__):
            raise request.param("no frame today")

        return fails

    def beside(self, viewer, device, tmp_path, alone, swarm):
        clients = swarm.connect(1)

        def act(iteration):
            swarm.send(clients, moved(iteration))
            wait_for(lambda: viewer._clients, "the client")

        trained_beside(viewer, device, tmp_path, alone, act)
        swarm.close(clients)

    def test_of_the_rendering_are_shown(self, viewer, device, tmp_path, alone, swarm, failing, monkeypatch):
        monkeypatch.setattr("clsplat.show.viewer.picture", failing)
        self.beside(viewer, device, tmp_path, alone, swarm)
        assert "no frame today" in viewer._drawn

    @pytest.mark.parametrize("where", ["_renderer.place", "_server.gui.add_button", "_write", "_frame"])
    def test_of_anything_else_are_one_warning(self, viewer, device, tmp_path, alone, swarm, monkeypatch, where):
        def fails(*_, **__):
            raise MemoryError("no room")

        *path, name = where.split(".")
        owner = viewer
        for part in path:
            owner = getattr(owner, part)
        monkeypatch.setattr(owner, name, fails)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            self.beside(viewer, device, tmp_path, alone, swarm)
        assert [str(w.message) for w in caught] == [
            "the viewer failed: MemoryError: no room; its frames may be missing or old"
        ]

    def test_of_sending_do_not_repeat_the_frame(self, viewer, monkeypatch, swarm):
        clients = swarm.connect(1)
        swarm.send(clients, camera_message())
        wait_for(lambda: viewer._clients, "the client")
        (client,) = viewer._clients.values()

        def fails(*_, **__):
            raise BrokenPipeError("gone")

        monkeypatch.setattr(client.handle.scene, "set_background_image", fails)
        with pytest.warns(UserWarning, match="the viewer failed: BrokenPipeError: gone"):
            assert viewer.draw(cameras()[0])
        assert client.shown.camera is client.camera
        swarm.close(clients)

    def test_an_interruption_is_no_error_of_the_viewer(self, viewer, monkeypatch):
        def interrupted(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(viewer, "draw", interrupted)
        with pytest.raises(KeyboardInterrupt):
            viewer.follow(cameras()[0], lambda: False)
