"""The pixels of the training photos, from which each iteration draws some."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.fields.space import Space, transparent
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
    """The pixels of photos that are used. The photos stay as they are: a copy would take as much memory again.

    Parameters
    ----------
    views : list of View
    space : Space
    loaded_on : RGB
        Background on which transparent photos were loaded.
    """

    def __init__(self, views: list[View], space: Space, loaded_on: Color):
        self._views = [view.loaded() for view in views]
        self._space, self._loaded_on = space, np.asarray(loaded_on)
        self._used = [_used(view) for view in self._views]
        pairs = zip(self._views, self._used, strict=True)
        counts = [view.camera.width * view.camera.height if used is None else len(used) for view, used in pairs]
        self._first = np.cumsum([0, *counts])
        self.transparent = transparent(self._views)

    def draw(self, rng: np.random.Generator, count: int) -> Batch:
        """Draw pixels, each with the same chance; transparent photos are shown on a random background."""
        background = rng.uniform(size=3) if self.transparent else self._loaded_on
        chosen = np.sort(rng.integers(self._first[-1], size=count))
        starts = np.searchsorted(chosen, self._first)
        origins, directions, radii = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
        colors = np.empty((count, 3))
        for view, used, first, begin, end in zip(
            self._views, self._used, self._first, starts, starts[1:], strict=False
        ):
            if begin < end:
                own = chosen[begin:end] - first
                v, u = np.divmod(own if used is None else used[own], view.camera.width)
                at = view.camera, u + 0.5, v + 0.5
                origins[begin:end], directions[begin:end] = self._space.rays(*at)
                radii[begin:end] = self._space.radii(*at)
                colors[begin:end] = view.image[v, u] / 255
                if view.clear is not None:
                    colors[begin:end] += view.clear[v, u, None] / 255 * (background - self._loaded_on)
        seen = np.isfinite(directions).all(axis=1)  # a fisheye sees nothing in its corners
        light = (float(background[0]), float(background[1]), float(background[2]))
        return Batch(origins[seen], directions[seen], radii[seen], np.clip(colors[seen], 0, 1), light)


def _used(view: View) -> NDArray[np.uint32] | None:
    """Places of the pixels that count in the flat photo; None if all do."""
    return None if view.mask is None or view.mask.all() else np.flatnonzero(view.mask).astype(np.uint32)
