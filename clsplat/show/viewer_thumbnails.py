"""A grid of thumbnails in the viewer: each is a button that moves the view to its photo's camera."""

import base64
import io
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from clsplat.gaussians import Gaussians
from clsplat.show.viewer_panel import Panel
from clsplat.show.viewer_tasks import Task

if TYPE_CHECKING:
    from clsplat.scene import View

THUMBNAILS_MAX = 240
"""Largest number of thumbnails: about a megabyte for the browser. Of more photos, every n-th is in the grid."""

EDGES = (66, 50)
"""Width and height of a thumbnail, px: four in a row of the panel."""

SENT_EVERY = 24
"""Thumbnails after which the grid is sent again while it is made."""


def scaled(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """A photo (H, W, 3) within a width and a height."""
    small = Image.fromarray(image)
    small.thumbnail((width, height))
    return np.asarray(small)


class Thumbnails:
    """Make the grid on demand, because it needs every photo.

    viser has no buttons with pictures. So the grid is a group of buttons with the photos' names, and a style sheet
    gives them pictures.

    Parameters
    ----------
    panel : Panel
    views : list of View
    chosen : callable
        Called with a browser's handle and the index of the view whose thumbnail was clicked.
    later : callable
        Takes a function that the owner of the device calls, and whose steps run between frames.
    """

    def __init__(
        self,
        panel: Panel,
        views: "list[View]",
        chosen: Callable[[Any, int], None],
        later: Callable[[Task], None],
    ):
        self._views, self._indices = views, range(0, len(views), -(-len(views) // THUMBNAILS_MAX))
        index = {views[i].name: i for i in self._indices}
        self._button = panel.button("All photos", lambda _: later(self._made), hint="Thumbnails to choose from")
        self._style, self._mark = panel.gui.add_html(""), panel.gui.add_html("")
        self._group = panel.buttons(
            "Thumbnails", list(index), lambda event: chosen(event.client, index[event.target.value])
        )
        self._group.visible = False
        # The row of the group: its label, and a box with the buttons.
        self._row = f'div:has(> div > p > label[for="{self._group._impl.uuid}"])'

    def _made(self, _: Gaussians) -> Iterator[None] | None:
        return None if self._group.visible else self._filled()

    def _filled(self) -> Iterator[None]:
        """Show the group, and give its buttons their pictures."""
        width, height = EDGES
        rules = [
            f"{self._row} > div:first-child {{display: none}}",
            f"{self._row} > div > div {{max-height: {5 * (height + 6)}px; overflow-y: auto; padding: 3px}}",
            f"{self._row} button {{width: {width}px; height: {height}px; flex: none !important; padding: 0; "
            "min-width: 0 !important; border: 0; font-size: 0; background: #888 center / cover}",
        ]
        self._button.visible, self._group.visible = False, True
        for number, index in enumerate(self._indices, start=1):
            # Twice the size, for screens with small pixels.
            file = io.BytesIO()
            Image.fromarray(scaled(self._views[index].image, 2 * width, 2 * height)).save(file, "JPEG", quality=70)
            data = base64.b64encode(file.getvalue()).decode()
            rules.append(
                f"{self._row} button:nth-child({number}) {{background-image: url(data:image/jpeg;base64,{data})}}"
            )
            if number % SENT_EVERY == 0 or number == len(self._indices):
                self._style.content = f"<style>{' '.join(rules)}</style>"
            yield

    def mark(self, index: int) -> None:
        """Put a frame around the thumbnail of a view."""
        number = self._indices.index(index) + 1 if index in self._indices else 0
        self._mark.content = f"<style>{self._row} button:nth-child({number}) {{outline: 3px solid #ff8c00}}</style>"
