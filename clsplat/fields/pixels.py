"""The pixels of the training photos, from which each iteration draws some."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.fields.space import Space
from clsplat.scene import Color, View

Array = NDArray[Any]


class Batch(NamedTuple):
    """Rays of an iteration, and what they should see.

    origins, directions (R, 3) in the field's coordinates; radii (R,), see `Space.radii`; colors (R, 3) in [0, 1], on
    the background; background RGB.
    """

    origins: Array
    directions: Array
    radii: Array
    colors: Array
    background: Color


class Pixels:
    """The pixels of photos that are used, in one array.

    Parameters
    ----------
    views : list of View
    space : Space
    loaded_on : RGB
        Background on which transparent photos were loaded.
    """

    def __init__(self, views: list[View], space: Space, loaded_on: Color):
        self._views, self._space, self._loaded_on = views, space, np.asarray(loaded_on)
        self._first = np.cumsum([0] + [view.image.shape[0] * view.image.shape[1] for view in views])
        self._colors = np.concatenate([view.image.reshape(-1, 3) for view in views])
        self.transparent = any(view.clear is not None for view in views)
        if self.transparent:
            self._clear = np.concatenate([_clear(view).ravel() for view in views])
        used = np.concatenate([view.counts.ravel() for view in views])
        self._used = None if used.all() else np.flatnonzero(used)

    def draw(self, rng: np.random.Generator, count: int) -> Batch:
        """Draw pixels, each with the same chance; transparent photos are shown on a random background."""
        background = rng.uniform(size=3) if self.transparent else self._loaded_on
        chosen = rng.integers(self._first[-1] if self._used is None else len(self._used), size=count)
        pixels = np.sort(chosen if self._used is None else self._used[chosen])
        starts = np.searchsorted(pixels, self._first)
        origins, directions, radii = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
        for view, first, begin, end in zip(self._views, self._first, starts, starts[1:], strict=False):
            if begin < end:
                v, u = np.divmod(pixels[begin:end] - first, view.camera.width)
                at = view.camera, u + 0.5, v + 0.5
                origins[begin:end], directions[begin:end] = self._space.rays(*at)
                radii[begin:end] = self._space.radii(*at)
        colors = self._colors[pixels] / 255
        if self.transparent:
            colors += self._clear[pixels, None] / 255 * (background - self._loaded_on)
        seen = np.isfinite(directions).all(axis=1)  # a fisheye sees nothing in its corners
        light = (float(background[0]), float(background[1]), float(background[2]))
        return Batch(origins[seen], directions[seen], radii[seen], np.clip(colors[seen], 0, 1), light)


def _clear(view: View) -> NDArray[np.uint8]:
    return np.zeros(view.image.shape[:2], np.uint8) if view.clear is None else view.clear
