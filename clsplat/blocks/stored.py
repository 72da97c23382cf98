"""A scene that stays on the disk: cameras show it, and those Gaussians are in memory that they may show."""

from collections.abc import Iterable, Iterator
from itertools import compress
from pathlib import Path

import numpy as np

from clsplat.blocks.parts import bounds_of, parts_of, read_part
from clsplat.blocks.sight import Bounds, looking_at, seen
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer

BATCH = 16
"""Most cameras for which Gaussians are read together: each part is read once for them, not once for each."""

SHARE = 1 / 4
"""Largest fraction of the device's memory that the parameters of these Gaussians may take, if there is more than one
camera. With what rendering needs, they take two to three times as much (`clsplat.training.memory`)."""


class StoredScene:
    """The Gaussians of a PLY, for `clsplat.render.renderings`: images have the bits of the whole scene's.

    Parameters
    ----------
    path : Path
        As `clsplat.blocks.whole.merge` wrote it.

    Raises
    ------
    InputError
        If the file cannot be read.
    """

    def __init__(self, path: Path):
        self._folder, self._parts = path.parent, list(parts_of(path))
        self._bounds = bounds_of(self._parts)
        self._none = read_part(self._folder, self._parts[0]).take(np.zeros(0, int))

    def __len__(self) -> int:
        return sum(part.rows for part in self._parts)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics."""
        return round(self._parts[0].coefficients ** 0.5) - 1

    def shown(self, renderer: Renderer, cameras: Iterable[Camera]) -> Iterator[tuple[list[Camera], Gaussians]]:
        """Yield the cameras, some at a time, and the Gaussians that these may show; both in their order.

        Raises
        ------
        InputError
            If the file cannot be read or has been changed.
        """
        cameras, count, fitted = list(cameras), BATCH, 0
        while cameras:
            gaussians = self._read(renderer, cameras[:count])
            if gaussians is None:
                count, fitted = min(count, len(cameras)) // 2, 0
                continue
            yield cameras[:count], gaussians
            cameras, fitted = cameras[count:], fitted + 1
            if fitted % 2 == 0:  # a batch that does not fit is read in vain
                count = min(BATCH, 2 * count)

    def _read(self, renderer: Renderer, cameras: list[Camera]) -> Gaussians | None:
        """Read the Gaussians that cameras may show; None if there are several cameras, and too many Gaussians."""
        most = np.inf if renderer.device is None or len(cameras) == 1 else SHARE * renderer.device.memory_limit
        found, size = [self._none], 0
        looking = looking_at(cameras, self._bounds, renderer.config)
        for k in np.flatnonzero(looking.any(axis=0)):
            gaussians = read_part(self._folder, self._parts[k])
            some = compress(cameras, looking[:, k])
            found.append(gaussians.take(seen(some, Bounds.of(gaussians), renderer.config)))
            size += sum(array.nbytes for array in found[-1].arrays().values())
            if size > most:
                return None
        return Gaussians.concatenate(found)
