"""Files in viewers that are not ours, in headless Chromium: the picture is that of our render."""

import functools
import threading
import urllib.parse
import warnings
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from browser import browser, wait_for
from foreign_code import FOREIGN, SCRIPTS, package, write_ksplat

from clsplat.camera import Camera
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.formats.spz import save_spz
from clsplat.metrics import psnr, to_uint8
from clsplat.render import render
from clsplat.show.camera_paths import overview
from clsplat.testing import synthetic_scene

WINDOW = (480, 360)

DB_MIN = 35.0
"""Smallest PSNR of a viewer's picture and ours, dB. They round differently, and cut Gaussians off elsewhere."""

PACKAGES = {
    "spark": "@sparkjsdev/spark",
    "mkkellogg": "@mkkellogg/gaussian-splats-3d",
    "babylon": "@babylonjs/loaders",
}

PLY, SPZ, GLB = np.eye(4), np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
"""From the world of a PLY to that of a file, which these viewers show unchanged."""


class Files(SimpleHTTPRequestHandler):
    """The folder of a test, and the packages beside it."""

    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".js": "text/javascript", ".wasm": "application/wasm"}

    def translate_path(self, path):
        name = urllib.parse.urlparse(path).path.lstrip("/")
        if name == "picture.html":
            return str(SCRIPTS / name)
        return str(FOREIGN / name) if name.startswith("node_modules/") else f"{self.directory}/{name}"

    def log_message(self, *_):
        pass


@pytest.fixture
def address(tmp_path):
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Files, directory=str(tmp_path)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def written(folder, name):
    """A scene of degree 2, the most that mkkellogg's viewer shows, in a file."""
    gaussians = synthetic_scene(200, seed=4, sh_degree=2)[0].astype(np.float32)
    gaussians.logit_opacities += 2
    path = folder / name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about data that the format cannot hold
        if name.endswith(".ksplat"):
            save_gaussians(folder / "source.ply", gaussians)
            write_ksplat(folder / "source.ply", path, 1, 2)
        elif name == "four.spz":
            save_spz(path, gaussians, version=4)
        else:
            save_gaussians(path, gaussians)
    return path


@pytest.mark.foreign
@pytest.mark.parametrize(
    ("viewer", "name", "world"),
    [
        ("spark", "a.ply", PLY),
        ("spark", "a.compressed.ply", PLY),
        ("spark", "a.splat", PLY),
        ("spark", "a.sog", PLY),
        ("spark", "a.spz", SPZ),
        ("mkkellogg", "a.ply", PLY),
        ("mkkellogg", "a.splat", PLY),
        ("mkkellogg", "a.ksplat", PLY),
        ("babylon", "a.glb", GLB),
    ],
)
def test_a_viewer_shows_our_render(device, tmp_path, address, viewer, name, world):
    package(PACKAGES[viewer])
    path = written(tmp_path, name)
    gaussians = load_gaussians(path)[0]
    centre, up = overview(gaussians).focus, np.array([0.0, -1.0, 0.0])
    # No large Gaussian is close to this camera: viewers limit sizes on the screen in different ways.
    camera = Camera.look_at(centre + np.array([2.8, -0.85, 1.05]), centre, up, 400, *WINDOW)
    ours = to_uint8(render(gaussians, camera, device=device).rgb)
    pose = world @ np.linalg.inv(camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
    fov = np.degrees(2 * np.arctan(WINDOW[1] / 2 / camera.fy))
    query = {"viewer": viewer, "file": f"/{name}", "fov": fov, "pose": ",".join(map(str, pose.ravel()))}
    url = f"{address}/picture.html?{urllib.parse.urlencode(query)}"
    with browser(tmp_path / "profile", url, *WINDOW) as page:
        wait_for(lambda: psnr(page.screenshot(), ours) > DB_MIN, f"{viewer} to show {name}: {page.log[-2:]}")
        assert psnr(page.screenshot()[:, ::-1], ours) < 25
