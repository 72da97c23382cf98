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
from clsplat.formats.tiles_3d import Z_UP


class Viewer(NamedTuple):
    """A viewer: its name for people, and its package of npm.

    worlds: by the suffix of a file, from the world of a PLY to the one in which the viewer shows it, if they differ.
    """

    label: str
    package: str
    worlds: dict[str, NDArray[np.float64]]


TILES = np.eye(4)
TILES[:3, :3] = Z_UP
SPZ, GLB = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])

VIEWERS = {
    "spark": Viewer("Spark", "@sparkjsdev/spark", {".spz": SPZ}),
    "mkkellogg": Viewer("GaussianSplats3D", "@mkkellogg/gaussian-splats-3d", {}),
    "babylon": Viewer("Babylon.js", "@babylonjs/core", {".glb": GLB}),
    "playcanvas": Viewer("PlayCanvas", "playcanvas", {}),
    "cesium": Viewer("CesiumJS", "cesium", {".json": TILES}),
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


def pose_of(viewer: str, name: str, camera: Camera) -> list[float]:
    """The camera in the world in which a viewer shows a file: camera to world, axes right, up, back, row by row."""
    world = VIEWERS[viewer].worlds.get(Path(name).suffix, np.eye(4))
    pose = world @ np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return [float(x) for x in pose.ravel()]


def picture_address(address: str, viewer: str, name: str, camera: Camera, allow: float | None = None) -> str:
    """Address of the page in which a viewer shows a file of the folder from a camera; `allow` limits its detail."""
    fov = np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))
    pose = ",".join(map(str, pose_of(viewer, name, camera)))
    query: dict[str, object] = {"viewer": viewer, "file": f"/{name}", "fov": fov, "pose": pose}
    return f"{address}/picture.html?{urllib.parse.urlencode(query | ({} if allow is None else {'allow': allow}))}"
