"""A scene as one HTML file that shows itself in any browser with WebGL2, without a network.

The page is PlayCanvas' SuperSplat Viewer (MIT; clsplat/show/vendor/README.md) with the scene, as SOG, and a first
camera in the block that its `renderViewerHtml` leaves for them.
"""

import base64
import gzip
import html
import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.config import BACKGROUNDS, Background, Mode
from clsplat.formats.sog import save_sog
from clsplat.gaussians import Gaussians
from clsplat.reference.sh import sh_basis
from clsplat.show.camera_paths import Viewpoint

Array = NDArray[Any]

VENDOR = Path(__file__).resolve().parent / "vendor"

TITLE = "<title>SuperSplat Viewer</title>"
BOOTSTRAP = '<script type="application/json" id="sse-bootstrap">\n            null\n'
STILL = "noanim: url.searchParams.has('noanim')"
ANTIALIASED = "aa: url.searchParams.has('aa')"
"""Where the viewer's page says its own name, expects what it is to show, and chooses whether the camera stands still
at first (else it circles, and soon shows what no photo did) and whether opacities are Mip-Splatting's."""

SAMPLES = 64
"""Random directions at which spherical harmonics are compared: more than the 16 coefficients of degree 3."""


def save_page(path: str | Path, gaussians: Gaussians, mode: Mode, start: Viewpoint, background: Background) -> None:
    """Write a page that shows Gaussians.

    Parameters
    ----------
    path : str or Path
        The file; its folder must exist.
    gaussians : Gaussians
        At least one, finite.
    mode : {"classic", "antialiased"}
        The rendering mode they were trained for.
    start : Viewpoint
        What is shown first. The viewer keeps its horizon level: a roll of the camera is lost, and the scene is turned
        so that `start.up` is upright.
    background : {"black", "white"}

    Raises
    ------
    InputError
        If the Gaussians cannot be stored, or the file cannot be written.
    """
    path = Path(path)
    turn, camera = upright(start.up), start.camera
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.sog"
        save_sog(scene, rotated(gaussians, turn), mode)
        data = base64.b64encode(scene.read_bytes()).decode()
    axis = camera.viewmat[2, :3]
    target = camera.position + max(abs(float((start.focus - camera.position) @ axis)), 1e-3) * axis
    shown = {
        "contentUrl": f"data:application/octet-stream;base64,{data}",
        "contentFilename": "scene.sog",
        "settings": {
            "version": 2,
            "tonemapping": "none",
            "highPrecisionRendering": False,
            "background": {"color": list(BACKGROUNDS[background])},
            "postEffectSettings": POST_EFFECTS,
            "animTracks": [],
            "cameras": [
                {
                    "initial": {
                        "position": _viewer_axes(turn @ camera.position),
                        "target": _viewer_axes(turn @ target),
                        # It becomes that of the window's longer edge, whatever the viewer's documentation says.
                        "fov": math.degrees(
                            2 * math.atan(max(camera.width / camera.fx, camera.height / camera.fy) / 2)
                        ),
                    }
                }
            ],
            "annotations": [],
            "startMode": "default",
        },
    }
    licence = (VENDOR / "supersplat-viewer.LICENSE").read_text(encoding="utf-8")
    notice = f"<!--\nShown by SuperSplat Viewer, https://github.com/playcanvas/supersplat-viewer\n\n{licence}-->\n"
    page = gzip.decompress((VENDOR / "supersplat-viewer.html.gz").read_bytes()).decode()
    for place, content in (
        (TITLE, f"<title>{html.escape(path.stem)}</title>"),
        # No "<" may stand in a script, where "</script>" would end it.
        (BOOTSTRAP, BOOTSTRAP.replace("null", json.dumps(shown).replace("<", "\\u003c"))),
        (STILL, "noanim: true"),
        (ANTIALIASED, f"aa: {'true' if mode == 'antialiased' else 'false'}"),
        ("<head>", f"{notice}<head>"),
    ):
        assert page.count(place) == 1, f"clsplat/show/vendor: expected a page with {place!r} once"
        page = page.replace(place, content)
    with replacing(path) as file:
        file.write(page.encode())


POST_EFFECTS: dict[str, dict[str, Any]] = {
    "sharpness": {"enabled": False, "amount": 0},
    "bloom": {"enabled": False, "intensity": 0.1, "blurLevel": 2},
    "grading": {"enabled": False, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
    "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
    "fringing": {"enabled": False, "intensity": 0.5},
}
"""The viewer's defaults, all off; it wants them spelled out."""


def _viewer_axes(point: Array) -> list[float]:
    """A point of a scene with y down in the viewer's world, y up: it turns scenes by 180 degrees about z."""
    return [-float(point[0]), -float(point[1]), float(point[2])]


def upright(up: Array) -> Array:
    """The smallest rotation, (3, 3), that brings `up` (3,) to -y."""
    from scipy.spatial.transform import Rotation

    if np.allclose(up / np.linalg.norm(up), [0, -1, 0], atol=1e-6):
        return np.eye(3)
    return np.asarray(Rotation.align_vectors([[0.0, -1.0, 0.0]], [up])[0].as_matrix())


def rotated(gaussians: Gaussians, rotation: Array) -> Gaussians:
    """The Gaussians in a world turned by `rotation` (3, 3), view dependence included.

    The turned colour is c'(d) = c(R^T d) for every direction d. The basis of each degree is closed under rotations:
    the least squares over directions, by which the new coefficients are found, have no residual.
    """
    from scipy.spatial.transform import Rotation

    if np.array_equal(rotation, np.eye(3)):
        return gaussians
    directions = np.random.default_rng(0).normal(size=(SAMPLES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    degree, dtype = gaussians.sh_degree, gaussians.means.dtype
    new, old = sh_basis(directions, degree), sh_basis(directions @ rotation, degree)
    matrix = np.linalg.lstsq(new, old, rcond=None)[0]
    norms = np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    turned = Rotation.from_matrix(rotation) * Rotation.from_quat(np.roll(gaussians.quats / norms, -1, axis=1))
    return replace(
        gaussians,
        means=(gaussians.means @ rotation.T).astype(dtype),
        quats=np.roll(turned.as_quat(), 1, axis=1).astype(dtype),
        sh=np.einsum("kl,nlc->nkc", matrix, gaussians.sh).astype(dtype),
    )
