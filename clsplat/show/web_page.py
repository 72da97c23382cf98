"""A scene as one HTML file, which any browser with WebGL2 shows without a network.

The page is PlayCanvas' SuperSplat Viewer (MIT; clsplat/show/vendor/README.md). Its `renderViewerHtml` leaves a block
for the content, into which the scene, as SOG, and the first camera are written.
"""

import base64
import gzip
import html
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.config import BACKGROUNDS, Background, Mode
from clsplat.formats.axes import rotated
from clsplat.formats.quantisation import checked
from clsplat.formats.sog import write_sog
from clsplat.gaussians import Gaussians
from clsplat.show.browser_cameras import target_of
from clsplat.show.camera_paths import Viewpoint

Array = NDArray[Any]

VENDOR = Path(__file__).resolve().parent / "vendor"

TITLE = "<title>SuperSplat Viewer</title>"
BOOTSTRAP = '<script type="application/json" id="sse-bootstrap">\n            null\n'
STILL = "noanim: url.searchParams.has('noanim')"
ANTIALIASED = "aa: url.searchParams.has('aa')"
"""Parts of the viewer's page that are replaced: its title, its content, whether the camera stands still at first
(otherwise it circles, and soon leaves the directions of the photos), and whether opacities are those of
Mip-Splatting."""


def save_page(path: str | Path, gaussians: Gaussians, mode: Mode, start: Viewpoint, background: Background) -> None:
    """Write a page that shows Gaussians.

    Parameters
    ----------
    path : str or Path
        The file. Its folder must exist.
    gaussians : Gaussians
        At least one, finite.
    mode : {"classic", "antialiased"}
        The rendering mode that they were trained for.
    start : Viewpoint
        The first view. The viewer keeps its horizon level: the scene is turned so that `start.up` is upright, and a
        roll of the camera is lost.
    background : {"black", "white"}

    Raises
    ------
    InputError
        If the Gaussians cannot be stored, or the file cannot be written.
    """
    path = Path(path)
    turn = upright(start.up)
    scene = io.BytesIO()
    write_sog(scene, checked(path, rotated(gaussians, turn)), mode, None)
    data = base64.b64encode(scene.getvalue()).decode()
    shown = {
        "contentUrl": f"data:application/octet-stream;base64,{data}",
        "contentFilename": "scene.sog",
        "settings": viewer_settings(start, turn, background),
    }
    licence = (VENDOR / "supersplat-viewer.LICENSE").read_text(encoding="utf-8")
    notice = f"<!--\nShown by SuperSplat Viewer, https://github.com/playcanvas/supersplat-viewer\n\n{licence}-->\n"
    page = gzip.decompress((VENDOR / "supersplat-viewer.html.gz").read_bytes()).decode()
    for place, content in (
        (TITLE, f"<title>{html.escape(path.stem)}</title>"),
        # A script must not contain "<": "</script>" would end it.
        (BOOTSTRAP, BOOTSTRAP.replace("null", json.dumps(shown).replace("<", "\\u003c"))),
        (STILL, "noanim: true"),
        (ANTIALIASED, f"aa: {'true' if mode == 'antialiased' else 'false'}"),
        ("<head>", f"{notice}<head>"),
    ):
        assert page.count(place) == 1, f"clsplat/show/vendor: expected a page with {place!r} once"
        page = page.replace(place, content)
    with replacing(path) as file:
        file.write(page.encode())


def viewer_settings(start: Viewpoint, turn: Array, background: Background) -> dict[str, Any]:
    """Make the settings of the viewer: background and first camera, everything else off.

    Parameters
    ----------
    start : Viewpoint
    turn : (3, 3)
        Rotation of the scene that makes the viewpoint upright.
    background : {"black", "white"}
    """
    camera, target = start.camera, target_of(start.camera, start.focus)
    # Contrary to the viewer's documentation, this is the field of view across the window's longer edge.
    fov = math.degrees(2 * math.atan(max(camera.width / camera.fx, camera.height / camera.fy) / 2))
    pose = {"position": _viewer_axes(turn @ camera.position), "target": _viewer_axes(turn @ target), "fov": fov}
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": list(BACKGROUNDS[background])},
        "postEffectSettings": POST_EFFECTS,
        "animTracks": [],
        "cameras": [{"initial": pose}],
        "annotations": [],
        "startMode": "default",
    }


POST_EFFECTS: dict[str, dict[str, Any]] = {
    "sharpness": {"enabled": False, "amount": 0},
    "bloom": {"enabled": False, "intensity": 0.1, "blurLevel": 2},
    "grading": {"enabled": False, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
    "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
    "fringing": {"enabled": False, "intensity": 0.5},
}
"""The viewer's defaults, all off. The viewer requires each of them."""


def _viewer_axes(point: Array) -> list[float]:
    """Convert a point of a scene, y down, to the viewer's world, y up, which is turned by 180 degrees about z."""
    return [-float(point[0]), -float(point[1]), float(point[2])]


def upright(up: Array) -> Array:
    """The smallest rotation (3, 3) that turns `up` (3,) to -y."""
    from scipy.spatial.transform import Rotation

    if np.allclose(up / np.linalg.norm(up), [0, -1, 0], atol=1e-6):
        return np.eye(3)
    return np.asarray(Rotation.align_vectors([[0.0, -1.0, 0.0]], [up])[0].as_matrix())
