"""Inputs of the viewer for edits of a scene: crop box and sphere, selection, deletion, undo, save."""

from collections.abc import Callable
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.pruning.viewpoints import bounds
from clsplat.show.edits import Edits, Region
from clsplat.show.viewer_panel import Panel

Save = Callable[[Gaussians], str]
"""Saves Gaussians, and returns a sentence about it."""

CROPS = ("off", "box", "sphere")
"""Regions outside which nothing is shown or saved."""

REGION_RADII = 2.0
"""Half edge of the first box and radius of the first sphere, in radii of the scene, which hold half of it."""

EXTENT_MAX = 100.0
"""Largest coordinate of a region, in the largest coordinate of the scene."""

HELP = (
    "Hold **Shift** and drag over the picture to select what is under the rectangle, at any depth. What is selected "
    "is orange."
)


class Editing:
    """Maker of the inputs, which carries out what they ask for on the thread that owns the device.

    Parameters
    ----------
    panel : Panel
    scene : viser.SceneApi
    gaussians : Gaussians
        On the host; not changed.
    save : callable
    later : callable
        Takes a function of the Gaussians that the owner of the device calls.
    """

    def __init__(self, panel: Panel, scene: Any, gaussians: Gaussians, save: Save, later: Callable[[Any], None]):
        self._edits, self._save, self._later, self._scene = Edits(gaussians), save, later, scene
        self._new = False
        self._outline: Any = None
        centre, radius = bounds(gaussians)
        limit = EXTENT_MAX * max(float(np.abs(gaussians.means).max()), radius)
        reach, step = float(f"{REGION_RADII * radius:.3g}"), radius / 100
        x, y, z = (float(f"{value:.3g}") for value in centre)
        gui = panel.gui
        self._crop = panel.dropdown("Crop", CROPS, lambda _: self._do(self._region))
        self._centre = panel.vector("Centre", (x, y, z), limit, step, lambda _: self._do(self._region))
        self._reach = panel.vector("Half size", (reach,) * 3, limit, step, lambda _: self._do(self._region))
        panel.button("Delete outside", lambda _: self._do(self._edits.crop))
        gui.add_markdown(HELP)
        panel.button(
            "Select isolated",
            lambda _: self._do(self._edits.select_isolated),
            hint="Gaussians that are far from their neighbours",
        )
        panel.button("Select none", lambda _: self._do(self._edits.select_none))
        panel.button("Delete selected", lambda _: self._do(self._edits.delete))
        panel.button("Undo", lambda _: self._do(self._edits.undo))
        panel.button("Save", lambda _: self._do(self._saved))
        self._text = gui.add_markdown("")
        self._tell()

    def _do(self, action: Callable[[], object]) -> None:
        def task(_: Gaussians) -> None:
            said = action()
            self._new = True
            self._tell(said if isinstance(said, str) else "")

        self._later(task)

    def select(self, camera: Camera, low: tuple[float, float], high: tuple[float, float]) -> None:
        """Select what a browser's camera sees in a rectangle, whose corners are fractions of the window."""
        self._do(lambda: self._edits.select_rectangle(camera, low, high))

    def changed(self) -> Gaussians | None:
        """The Gaussians to show, if they are others than at the last call."""
        if not self._new:
            return None
        self._new = False
        return self._edits.shown()

    def _region(self) -> None:
        before, shape = self._edits.region, self._crop.value
        centre, reach = tuple(self._centre.value), tuple(max(abs(v), 1e-9) for v in self._reach.value)
        self._edits.region = None if shape == "off" else Region(shape, centre, reach)
        try:
            self._edits.result()
        except Exception:
            self._edits.region = before
            raise
        if self._outline is not None:
            self._outline.remove()
            self._outline = None
        wireframe = {"wireframe": True, "color": (255, 255, 255), "position": centre}
        if shape == "box":
            self._outline = self._scene.add_box("/crop", dimensions=tuple(2 * half for half in reach), **wireframe)
        elif shape == "sphere":
            self._outline = self._scene.add_icosphere("/crop", radius=reach[0], subdivisions=2, **wireframe)

    def _saved(self) -> str:
        return self._save(self._edits.result())

    def _tell(self, said: str = "") -> None:
        edits = self._edits
        self._text.content = (
            f"{len(edits):,} of {len(edits.kept):,} Gaussians, {int(edits.selected.sum()):,} selected, "
            f"{edits.steps} to undo" + (f"  \n{said}" if said else "")
        )
