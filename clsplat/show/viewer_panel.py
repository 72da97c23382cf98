"""The panel of the viewer: viser's inputs, each of which has a rule for the values that a page may send."""

import math
from collections.abc import Callable, Sequence
from typing import Any

Inputs = dict[str, Callable[[Any], bool]]
"""The inputs of the panel by their identifiers: whether an input can have a value."""

Changed = Callable[[Any], None]
"""Called with viser's event after a change, on a thread of viser."""


def _number(value: Any, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high


class Panel:
    """Maker of inputs, which records which values they can have.

    Parameters
    ----------
    gui : viser.GuiApi
    inputs : dict
        Those that messages of a page may change; the panel adds its own.
    """

    def __init__(self, gui: Any, inputs: Inputs):
        self.gui, self._inputs = gui, inputs

    def _added(self, handle: Any, rule: Callable[[Any], bool], changed: Changed | None) -> Any:
        self._inputs[handle._impl.uuid] = rule
        if changed is not None:
            (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(changed)
        return handle

    def button(self, label: str, clicked: Changed, hint: str | None = None) -> Any:
        """A button."""
        return self._added(self.gui.add_button(label, hint=hint), lambda value: isinstance(value, bool), clicked)

    def buttons(self, label: str, options: Sequence[str], clicked: Changed) -> Any:
        """A group of buttons; the value of the event's target is the option that was clicked."""
        known = set(options)
        handle = self.gui.add_button_group(label, tuple(options))
        return self._added(handle, lambda value: isinstance(value, str) and value in known, clicked)

    def checkbox(self, label: str, value: bool, changed: Changed | None = None, hint: str | None = None) -> Any:
        """A box to check."""
        handle = self.gui.add_checkbox(label, value, hint=hint)
        return self._added(handle, lambda value: isinstance(value, bool), changed)

    def dropdown(self, label: str, options: Sequence[str], changed: Changed | None = None) -> Any:
        """A choice, at first of the first option."""
        known = set(options)
        handle = self.gui.add_dropdown(label, tuple(options))
        return self._added(handle, lambda value: isinstance(value, str) and value in known, changed)

    def slider(
        self, label: str, ends: tuple[float, float], step: float, value: float, changed: Changed | None = None
    ) -> Any:
        """A number between two ends."""
        handle = self.gui.add_slider(label, *ends, step, value)
        return self._added(handle, lambda value: _number(value, *ends), changed)

    def color(self, label: str, value: tuple[int, int, int], changed: Changed | None = None) -> Any:
        """An RGB colour, each channel 0 to 255."""
        handle = self.gui.add_rgb(label, value)

        def holds(value: Any) -> bool:
            return isinstance(value, tuple) and all(_number(part, 0, 255) for part in value)

        return self._added(handle, holds, changed)

    def vector(
        self, label: str, value: tuple[float, float, float], limit: float, step: float, changed: Changed | None = None
    ) -> Any:
        """Three numbers of a magnitude up to `limit`."""
        low, high = (-limit,) * 3, (limit,) * 3
        handle = self.gui.add_vector3(label, value, min=low, max=high, step=step)

        def holds(value: Any) -> bool:
            return isinstance(value, tuple) and all(
                _number(part, -limit, limit) and math.isfinite(part) for part in value
            )

        return self._added(handle, holds, changed)
