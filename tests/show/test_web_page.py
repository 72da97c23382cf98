"""The web page of a scene: rotation of Gaussians, content of the page, and its picture in a browser."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import browser, wait_for
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.cli import main
from clsplat.config import RenderConfig
from clsplat.formats import load_gaussians, save_gaussians
from clsplat.formats.axes import rotated
from clsplat.metrics import psnr, to_uint8
from clsplat.render import render
from clsplat.show.camera_paths import Viewpoint, overview
from clsplat.show.web_page import VENDOR, save_page, upright
from clsplat.testing import synthetic_scene

WINDOW = (480, 360)


def scene(degree=3):
    """A scene opaque enough that right and wrong views differ."""
    gaussians, _ = synthetic_scene(200, seed=4)
    gaussians.logit_opacities[:] += 2
    return replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_turned_scene_looks_the_same_from_a_turned_camera(device64, degree):
    gaussians = scene(degree).astype(np.float64)
    gaussians.sh[:] *= 3
    camera = overview(gaussians).camera.resized(64, 48)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix()
    turned = rotated(gaussians, turn[:3, :3])
    before = render(gaussians, camera, device=device64).rgb
    after = render(turned, replace(camera, viewmat=camera.viewmat @ turn.T), device=device64).rgb
    assert np.ptp(before) > 0.3
    np.testing.assert_allclose(after, before, atol=1e-9)


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 1, 0), (0.3, 0.1, -2), (1, 0, 0)])
def test_upright(up):
    turn = upright(np.array(up, float))
    np.testing.assert_allclose(turn @ up, np.linalg.norm(up) * np.array([0, -1, 0]), atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) > 0


def test_a_page_needs_no_folder_for_temporary_files(tmp_path, monkeypatch):
    """A full disk there was reported by the name of a file that the user does not know."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    gaussians = scene()
    save_page(tmp_path / "scene.html", gaussians, "classic", overview(gaussians), "black")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.html"]


def test_the_viewer_has_the_hash_that_its_readme_names():
    text = (VENDOR / "README.md").read_text()
    assert hashlib.sha256((VENDOR / "supersplat-viewer.html.gz").read_bytes()).hexdigest() in text


class TestExport:
    def test_holds_scene_licence_and_name(self, tmp_path):
        gaussians = scene()
        save_gaussians(tmp_path / "scene.ply", gaussians)
        main(["export", str(tmp_path / "scene.ply"), str(tmp_path / "a <b>.html")])
        text = (tmp_path / "a <b>.html").read_text()
        assert "<title>a &lt;b&gt;</title>" in text
        assert "Permission is hereby granted, free of charge" in text
        shown = json.loads(re.search(r'id="sse-bootstrap">\s*(.*?)\s*</script>', text, flags=re.S)[1])
        (tmp_path / "inside.sog").write_bytes(base64.b64decode(shown["contentUrl"].split(",")[1]))
        assert len(load_gaussians(tmp_path / "inside.sog")[0]) == len(gaussians)

    @pytest.mark.parametrize("arguments", [[], ["a.spz", "-o", "b.spz"]])
    def test_requires_one_file(self, tmp_path, capsys, arguments):
        save_gaussians(tmp_path / "scene.ply", scene())
        with pytest.raises(SystemExit):
            main(["export", str(tmp_path / "scene.ply"), *arguments])
        assert "expected one file to write" in capsys.readouterr().err

    def test_o_is_the_same_as_a_positional_argument(self, tmp_path):
        save_gaussians(tmp_path / "scene.ply", scene())
        main(["export", str(tmp_path / "scene.ply"), str(tmp_path / "a.sog")])
        main(["export", str(tmp_path / "scene.ply"), "-o", str(tmp_path / "b.sog")])
        assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


@pytest.mark.parametrize(
    ("up", "mode"),
    [((0, -1, 0), "classic"), ((0.5, -0.2, 0.7), "antialiased")],
    ids=["y down", "tilted world, antialiased"],
)
def test_a_browser_without_a_network_shows_the_render(device, tmp_path: Path, up, mode):
    gaussians = scene()
    gaussians.log_scales[::2] -= 3  # smaller than a pixel, where the modes differ
    gaussians.logit_opacities[::2] += 3
    centre, up = overview(gaussians).focus, np.array(up) / np.linalg.norm(up)
    beside = np.cross(up, [1.0, 2.0, 3.0])
    camera = Camera.look_at(centre + 3 * beside / np.linalg.norm(beside) + 0.8 * up, centre, up, 400, *WINDOW)
    save_page(tmp_path / "scene.html", gaussians, mode, Viewpoint(camera, centre, up), "black")
    save_gaussians(tmp_path / "scene.sog", gaussians)  # the page shows the scene as quantised by this format
    stored = load_gaussians(tmp_path / "scene.sog")[0]
    ours, other = (
        to_uint8(render(stored, camera, RenderConfig(mode=m), device).rgb)
        for m in (mode, "classic" if mode == "antialiased" else "antialiased")
    )
    url = (tmp_path / "scene.html").as_uri() + "?noui&webgl"
    with browser(tmp_path / "profile", url, *WINDOW) as page:
        # Mirrored, turned or upside down it has less than 20 dB. The two renderers round differently.
        wait_for(lambda: psnr(page.screenshot(), ours) > 30, "the scene as clsplat renders it")
        shot = page.screenshot()
        apart = np.abs(ours.astype(int) - other) > 20
        away_from = [np.abs(shot.astype(int) - image)[apart].mean() for image in (ours, other)]
        assert apart.any() and away_from[0] < away_from[1], "opacities of the other mode"
        assert psnr(shot[:, ::-1], ours) < 20
        assert page.requests[0] == url
        assert all(request.startswith(("data:", "blob:")) for request in page.requests[1:])
