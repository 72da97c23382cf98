"""Files in viewers that are not ours, in headless Chromium: the picture is that of our render."""

import warnings

import numpy as np
import pytest
from browser import browser, wait_for
from foreign_code import package, write_ksplat
from viewers import VIEWERS, picture_address, served

from clsplat.camera import Camera
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.formats.spz import save_spz
from clsplat.formats.streamed_sog import LOD_META, StreamedSogWriter
from clsplat.formats.tiles_3d import TILESET, TilesWriter
from clsplat.metrics import psnr, to_uint8
from clsplat.pruning.levels import detail_tree
from clsplat.render import render
from clsplat.show.camera_paths import overview
from clsplat.testing import synthetic_scene

WINDOW = (480, 360)

DB_MIN = 35.0
"""Smallest PSNR of a viewer's picture and ours, dB. They round differently, and cut Gaussians off elsewhere."""


@pytest.fixture
def address(tmp_path):
    with served(tmp_path) as address:
        yield address


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
    ("viewer", "name"),
    [
        ("spark", "a.ply"),
        ("spark", "a.compressed.ply"),
        ("spark", "a.splat"),
        ("spark", "a.sog"),
        ("spark", "a.spz"),
        ("mkkellogg", "a.ply"),
        ("mkkellogg", "a.splat"),
        ("mkkellogg", "a.ksplat"),
        ("babylon", "a.glb"),
        ("playcanvas", "a.ply"),
        ("playcanvas", "a.compressed.ply"),
        ("playcanvas", "a.sog"),
    ],
)
def test_a_viewer_shows_our_render(device, tmp_path, address, viewer, name):
    package(VIEWERS[viewer].package)
    path = written(tmp_path, name)
    gaussians = load_gaussians(path)[0]
    centre, up = overview(gaussians).focus, np.array([0.0, -1.0, 0.0])
    # No large Gaussian is close to this camera: viewers limit sizes on the screen in different ways.
    camera = Camera.look_at(centre + np.array([2.8, -0.85, 1.05]), centre, up, 400, *WINDOW)
    ours = to_uint8(render(gaussians, camera, device=device).rgb)
    with browser(tmp_path / "profile", picture_address(address, viewer, name, camera), *WINDOW) as page:
        wait_for(lambda: psnr(page.screenshot(), ours) > DB_MIN, f"{viewer} to show {name}: {page.log[-2:]}")
        assert psnr(page.screenshot()[:, ::-1], ours) < 25


@pytest.mark.foreign
@pytest.mark.parametrize(
    ("viewer", "writer", "name", "fine", "coarse"),
    [("playcanvas", StreamedSogWriter, LOD_META, 200, 120), ("cesium", TilesWriter, TILESET, 1, 200)],
)
def test_a_viewer_shows_levels(device, tmp_path, address, viewer, writer, name, fine, coarse):
    package(VIEWERS[viewer].package)
    gaussians = load_gaussians(written(tmp_path, "a.ply"))[0]
    files = writer(tmp_path)
    for node in detail_tree(gaussians):
        files.add(node)
    files.finish()
    centre, up = overview(gaussians).focus, np.array([0.0, -1.0, 0.0])
    camera = Camera.look_at(centre + np.array([2.8, -0.85, 1.05]), centre, up, 400, *WINDOW)
    ours = to_uint8(render(load_gaussians(tmp_path / name)[0], camera, device=device).rgb)
    with browser(tmp_path / "profile", picture_address(address, viewer, name, camera, fine), *WINDOW) as page:
        wait_for(lambda: psnr(page.screenshot(), ours) > DB_MIN, f"{viewer} to show {name}: {page.log[-2:]}")
        assert page.evaluate("window.splats()") == 200
        page.evaluate(f"window.allow({coarse})")
        wait_for(lambda: page.evaluate("window.splats()") == 100, f"a coarser level: {page.log[-2:]}")
