"""Viewers that are not ours, in headless Chromium."""

import functools
import threading
import urllib.parse
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import NamedTuple

import numpy as np
from foreign_code import FOREIGN, SCRIPTS
from numpy.typing import NDArray

from clsplat.camera import Camera


class Viewer(NamedTuple):
    """A viewer: its name for people, and its package of npm.

    worlds: by the suffix of a file, from the world of a PLY to the one in which the viewer shows it, if they differ.
    """

    label: str
    package: str
    worlds: dict[str, NDArray[np.float64]]


SPZ, GLB = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])

VIEWERS = {
    "spark": Viewer("Spark", "@sparkjsdev/spark", {".spz": SPZ}),
    "mkkellogg": Viewer("GaussianSplats3D", "@mkkellogg/gaussian-splats-3d", {}),
    "babylon": Viewer("Babylon.js", "@babylonjs/core", {".glb": GLB}),
    "playcanvas": Viewer("PlayCanvas", "playcanvas", {}),
}
"""Viewers by their names in foreign/picture.html."""


class Files(SimpleHTTPRequestHandler):
    """A folder, and the packages of npm beside it."""

    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".js": "text/javascript", ".wasm": "application/wasm"}

    def translate_path(self, path: str) -> str:
        name = urllib.parse.urlparse(path).path.lstrip("/")
        if name == "picture.html":
            return str(SCRIPTS / name)
        return str(FOREIGN / name) if name.startswith("node_modules/") else f"{self.directory}/{name}"

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Address of a server of a folder and of the packages."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Files, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def picture_address(address: str, viewer: str, name: str, camera: Camera) -> str:
    """Address of the page in which a viewer shows a file of the folder from a camera."""
    world = VIEWERS[viewer].worlds.get(Path(name).suffix, np.eye(4))
    pose = world @ np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
    fov = np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))
    query = {"viewer": viewer, "file": f"/{name}", "fov": fov, "pose": ",".join(map(str, pose.ravel()))}
    return f"{address}/picture.html?{urllib.parse.urlencode(query)}"
