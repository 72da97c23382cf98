"""Who may connect to the viewer and what it reads, with a real server and real websockets."""

import http.client
import math
import socket
from types import SimpleNamespace

import numpy as np
import pytest
from browser import PATIENCE, wait_for
from small_scenes import cameras, views_of

viser = pytest.importorskip("viser", reason="viser, the extra `viewer`, is missing")

import msgspec  # noqa: E402
from viser import _messages  # noqa: E402
from websocket_clients import camera_message, own  # noqa: E402
from websockets import Headers  # noqa: E402
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from clsplat.errors import InputError  # noqa: E402
from clsplat.renderer import Renderer  # noqa: E402
from clsplat.show import viewer_server  # noqa: E402
from clsplat.show.browser_cameras import LARGEST_EDGE, LARGEST_FRAME, client_camera  # noqa: E402
from clsplat.show.camera_paths import first_photo  # noqa: E402
from clsplat.show.viewer import Viewer  # noqa: E402
from clsplat.show.viewer_server import LARGEST_MESSAGE, acceptable, is_own_page, start_server  # noqa: E402


def refused(**options):
    """Status of a handshake that fails."""
    with pytest.raises(InvalidStatus) as raised, connect(**options):
        pass
    return raised.value.response.status_code


def status(address, path):
    """Status of a plain request."""
    connection = http.client.HTTPConnection(address.removeprefix("http://").split("/")[0])
    connection.request("GET", path)
    result = connection.getresponse().status
    connection.close()
    return result


class TestOrigin:
    def test_its_own_page_connects(self, viewer):
        assert status(viewer.address, "/") == 200
        with connect(**own(viewer.address)) as socket_:
            socket_.send(camera_message())
            wait_for(lambda: viewer._clients, "the client")

    def test_by_the_name_localhost_as_well(self, viewer):
        port = viewer._server.get_port()
        address = f"http://localhost:{port}"
        with socket.create_connection(("127.0.0.1", port)) as raw, connect(**own(address, sock=raw)) as socket_:
            assert socket_.subprotocol == viser_protocol()

    @pytest.mark.parametrize(
        "origin",
        ["https://example.org", "http://127.0.0.1", "http://127.0.0.1:1", "http://localhost:1", "null", None],
    )
    def test_foreign_pages_do_not(self, viewer, origin):
        assert refused(**own(viewer.address, origin=origin)) == 403
        assert not viewer._server._websock_server._client_state_from_id

    def test_nor_a_page_whose_name_was_pointed_to_this_machine(self, viewer):
        port = viewer._server.get_port()
        with socket.create_connection(("127.0.0.1", port)) as raw:
            assert refused(**own(f"http://attack.example:{port}", sock=raw)) == 403

    @pytest.mark.parametrize(
        "host", ["localhost:8080", "127.0.0.1:8080", "[::1]:8080", "127.0.0.1:9000", "localhost"]
    )
    def test_every_name_of_this_machine_is_its_own(self, host):
        assert is_own_page(Headers({"Host": host, "Origin": f"http://{host}"}))
        assert not is_own_page(Headers({"Host": host, "Origin": f"http://{host}0"}))

    @pytest.mark.parametrize("host", ["192.168.0.1:8080", "localhost.example:8080", "127.0.0.1.example", "", "[x"])
    def test_and_no_other(self, host):
        try:
            assert not is_own_page(Headers({"Host": host, "Origin": f"http://{host}"}))
        except ValueError:  # which websockets answers by 500
            assert host == "[x"


def viser_protocol():
    return f"viser-v{viser.__version__}"


class TestToken:
    @pytest.fixture
    def opened(self, device):
        """A viewer that other machines reach, and the way to it by 127.0.0.1."""
        cams = cameras()[1]
        result = Viewer(host="0.0.0.0", port=18080)
        result.show(Renderer(device), first_photo(cams), views_of(cams))
        yield result, f"http://127.0.0.1:{result._server.get_port()}"
        result.close()

    def test_the_printed_address_opens_the_viewer(self, opened):
        viewer, here = opened
        start, _, token = viewer.address.rpartition("/")
        assert start == f"http://{socket.gethostname()}:{viewer._server.get_port()}"
        assert len(token) >= 43, "32 random bytes"
        assert status(here, f"/{token}") == status(here, f"/{token}/?websocket=ws://other") == 200
        # viser's page connects to the path of its own address; the name by which others know the machine is any.
        with connect(**own(f"{here}/{token}", origin="http://machine.example:8080")) as socket_:
            socket_.send(camera_message())
            wait_for(lambda: viewer._clients, "the client")

    def test_nothing_else_does(self, opened):
        viewer, here = opened
        token = viewer.address.rpartition("/")[2]
        for path in ("", "/", "/ä", f"/{token}x", f"/{token[:-1]}", f"/?{token}", f"/x/{token}"):
            assert refused(**own(f"{here}{path}")) == 403, path
        assert status(here, "/") == status(here, "/index.html") == 403

    def test_every_server_has_another(self, opened, device):
        second = Viewer(host="0.0.0.0", port=18080)
        second.close()
        assert second.address.rpartition("/")[2] != opened[0].address.rpartition("/")[2]

    def test_a_viewer_of_this_machine_needs_none(self, viewer):
        assert viewer.address == f"http://127.0.0.1:{viewer._server.get_port()}"


def test_a_server_that_cannot_be_checked_is_not_started(monkeypatch):
    stopped = []
    server = SimpleNamespace(stop=lambda: stopped.append(True))
    monkeypatch.setattr(viser, "ViserServer", lambda **_: server)
    with pytest.raises(InputError, match=r"viser: expected a version whose connections can be checked"):
        start_server("127.0.0.1", 18080, {})
    assert stopped


def test_websockets_is_as_before(viewer):
    import websockets.asyncio.server

    assert websockets.asyncio.server.serve is viewer_server.serve


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.host.invalid"])
def test_an_address_of_another_machine_is_a_sentence(host):
    with pytest.raises(InputError, match=f"--host: cannot listen on '{host}'"):
        start_server(host, 18080, {})


NAN, INF = float("nan"), float("inf")
NO_CAMERAS = {
    "position NaN": {"position": [0, NAN, 0]},
    "position infinite": {"position": [INF, 0, 0]},
    "position beyond float32": {"position": [0, 0, 1e300]},
    "quaternion zero": {"wxyz": [0, 0, 0, 0]},
    "quaternion NaN": {"wxyz": [NAN, 0, 0, 1]},
    "quaternion whose square is zero": {"wxyz": [1e-200, 0, 0, 0]},
    "field of view 0": {"fov": 0.0},
    "field of view of a denormal": {"fov": 5e-324},
    "field of view negative": {"fov": -1.0},
    "field of view of 400 degrees": {"fov": math.radians(400)},
    "field of view of 400": {"fov": 400.0},
    "field of view NaN": {"fov": NAN},
    "window without pixels": {"image_width": 0},
    "window of negative size": {"image_height": -5},
    "window of 100 000 px": {"image_width": 100_000, "image_height": 100_000},
    "window of 2^63 px": {"image_width": 2**63},
    "aspect 1e9": {"image_width": 10**9, "image_height": 1},
}
EACH_NO_CAMERA = pytest.mark.parametrize("changes", NO_CAMERAS.values(), ids=NO_CAMERAS)


class TestCameras:
    @EACH_NO_CAMERA
    def test_nonsense_is_refused(self, changes):
        values = msgspec.msgpack.decode(camera_message(**changes))
        names = ("wxyz", "position", "fov", "image_width", "image_height")
        with pytest.raises(InputError):
            client_camera(*(values[name] for name in names))
        assert acceptable(camera_message(), {}) and not acceptable(camera_message(**changes), {})

    @pytest.mark.parametrize(
        "size", [(LARGEST_EDGE, LARGEST_EDGE), (LARGEST_EDGE, 1), (5120, 2880), (1, LARGEST_EDGE)]
    )
    def test_the_number_of_pixels_is_bounded(self, size):
        camera = client_camera([1, 0, 0, 0], [0, 0, 0], 1.0, *size)
        pixels = camera.width * camera.height
        assert pixels <= LARGEST_FRAME
        assert pixels > 0.99 * LARGEST_FRAME or (camera.width, camera.height) == size
        assert camera.width / camera.fx == pytest.approx(2 * np.tan(0.5) * size[0] / size[1]), "the same view"


def click(**changes):
    fields = {"instance_index": None, "ray_origin": [0, 0, 0], "ray_direction": [0, 0, 1], "screen_pos": [0.5, 0.5]}
    return {"type": "SceneNodeClickMessage", "name": "/cameras/3.png", **fields, "modifier": None, **changes}


class TestMessages:
    """The server reads what viser's page of this version sends, and nothing else."""

    @pytest.mark.parametrize(
        "message",
        [
            _messages.ViewerCameraMessage((1, 0, 0, 0), (0, 0, 0), 1.0, 0.1, 10.0, 48, 64, (0, 0, 1), (0, 1, 0)),
            _messages.GuiUpdateMessage("5", {"value": "depth"}),
            _messages.GuiUpdateMessage("5", {"value": True}),
            _messages.GuiUpdateMessage("5", {"value": 2}),
            _messages.GuiUpdateMessage("5", {"value": [0.1, 2, 3]}),
            _messages.ScenePointerMessage("rect-select", None, None, ((0.1, 0.2), (0.5, 0.9)), "shift"),
            _messages.SceneNodeClickMessage("/cameras/1.png", None, (0, 0, 0), (0, 0, 1), (0.5, 0.5), None),
        ],
    )
    def test_those_of_visers_page_are_read(self, message):
        assert acceptable(msgspec.msgpack.encode(message.as_serializable_dict()), {"5": lambda value: True})

    @pytest.mark.parametrize(
        "message",
        [
            None,
            [],
            {},
            {"type": 5},
            {"type": "ShareUrlRequest"},
            {"type": "GuiFormDirtyMessage", "uuid": "x" * 1000},
            {"type": "FileTransferStartUpload"},
            {"type": "GuiUpdateMessage", "uuid": "5", "updates": {"update_cb": []}},
            {"type": "GuiUpdateMessage", "uuid": "5", "updates": {"value": [1]}},
            {"type": "GuiUpdateMessage", "uuid": 5, "updates": {"value": "depth"}},
            click(name=5),
            click(ray_origin=[0]),
            click(more=1),
            *({**msgspec.msgpack.decode(camera_message()), name: "x"} for name in ("wxyz", "fov", "image_width")),
        ],
        ids=str,
    )
    def test_others_are_not(self, message):
        assert not acceptable(msgspec.msgpack.encode(message), {"5": lambda value: True})

    def test_nor_is_what_is_no_message(self):
        assert not acceptable("text", {}) and not acceptable(b"", {}) and not acceptable(b"\xa1\xff", {})
        assert not acceptable(b"\x91" * 50_000, {}), "nested too deeply"

    @pytest.mark.parametrize(
        "changes",
        [{"look_at": [NAN] * 3}, {"look_at": [0, 0, -3.5]}, {"up_direction": [0] * 3}, {"up_direction": [INF, 0, 0]}],
        ids=str,
    )
    def test_nor_cameras_that_viser_cannot_move(self, changes):
        assert not acceptable(camera_message(**changes), {})

    def test_nonsense_leaves_the_connection_open(self, viewer):
        with connect(**own(viewer.address)) as socket_:
            socket_.send(camera_message())
            wait_for(lambda: viewer._clients, "the client")
            (client,) = viewer._clients.values()
            first = client.camera
            socket_.send("text")
            socket_.send(np.random.default_rng(1).bytes(1000))
            socket_.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
            for changes in NO_CAMERAS.values():
                socket_.send(camera_message(**changes))
            socket_.send(camera_message(position=[1, 2, 3]))
            wait_for(lambda: client.camera is not first, "the camera after the nonsense")
            np.testing.assert_allclose(client.camera.position, [1, 2, 3])

    def test_a_huge_message_ends_its_connection_only(self, viewer):
        with connect(**own(viewer.address)) as other, connect(**own(viewer.address)) as socket_:
            socket_.send(bytes(LARGEST_MESSAGE + 1))
            with pytest.raises(ConnectionClosed, match="1009"):
                while True:
                    socket_.recv(PATIENCE)
            other.send(camera_message())
            wait_for(lambda: viewer._clients, "the other client")

    def test_inputs_take_only_the_values_that_they_can_have(self, viewer, capfd):
        viewer.edit(cameras()[0], lambda gaussians: "saved")
        handles = dict(viewer._server.gui._gui_input_handle_from_uuid)
        # Every input has a rule, so that a new one cannot be forgotten.
        assert handles.keys() == viewer._panel._inputs.keys()
        before = {uuid: handle.value for uuid, handle in handles.items()}
        hostile = ["nonsense", "x" * 5000, -1, 2**40, 1e30, NAN, INF, [NAN, 0, 0], [-1, 300, 1e9], [1e30, 1, 1]]
        with connect(**own(viewer.address)) as socket_:
            socket_.send(camera_message())
            wait_for(lambda: viewer._clients, "the client")
            (client,) = viewer._clients.values()
            seen = client.camera
            for uuid in [*handles, "unknown"]:
                for value in hostile:
                    message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
                    socket_.send(msgspec.msgpack.encode(message))
            show = next(uuid for uuid, handle in handles.items() if handle.value == "render")
            message = {"type": "GuiUpdateMessage", "uuid": show, "updates": {"value": "normals"}}
            socket_.send(msgspec.msgpack.encode(message))
            socket_.send(camera_message(position=[1, 2, 3]))
            wait_for(lambda: client.camera is not seen, "the camera after the nonsense")
        assert {uuid: handle.value for uuid, handle in handles.items()} == before | {show: "normals"}
        assert viewer._look.look().mode == "normals"
        assert "Traceback" not in capfd.readouterr().err
