"""Inputs of the viewer for what a frame shows: contents, background, spherical harmonics, field of view."""

import math
from collections.abc import Callable
from typing import Any

from clsplat.constants import SH_DEGREE_MAX
from clsplat.scene import Color
from clsplat.show.frames import MODES, Look
from clsplat.show.viewer_panel import Panel

FIELDS_OF_VIEW = (10.0, 120.0)
"""Ends of the vertical field of view, degrees. Beyond them, a perspective is of no use to look at a scene."""


class LookInputs:
    """Maker of the inputs, which it also reads.

    Parameters
    ----------
    panel : Panel
    background : (3,) floats
        RGB of the renderer, 0 to 1.
    changed : callable
        Called after each change.
    """

    def __init__(self, panel: Panel, background: Color, changed: Callable[[], None]):
        red, green, blue = (round(255 * channel) for channel in background)
        self._mode = panel.dropdown("Show", MODES, lambda _: changed())
        self._degree = panel.slider("Harmonics", (0, SH_DEGREE_MAX), 1, SH_DEGREE_MAX, lambda _: changed())
        self._background = panel.color("Background", (red, green, blue), lambda _: changed())
        self._field = panel.slider("Field of view", FIELDS_OF_VIEW, 1, 50.0, self._zoom)

    def _zoom(self, event: Any) -> None:
        if event.client is not None:
            event.client.camera.fov = math.radians(self._field.value)

    def tell_field(self, field: float) -> None:
        """Show a vertical field of view, radians, that the viewer has chosen."""
        self._field.value = min(max(round(math.degrees(field)), FIELDS_OF_VIEW[0]), FIELDS_OF_VIEW[1])

    def background(self) -> Color:
        """The colour behind the scene, 0 to 1."""
        red, green, blue = (channel / 255 for channel in self._background.value)
        return red, green, blue

    def look(self) -> Look:
        """Settings of a frame."""
        return Look(self._mode.value, self.background(), self._degree.value)
