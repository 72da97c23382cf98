"""A scene that stays on the disk: cameras show it, and those Gaussians are in memory that they may show."""

from collections.abc import Iterable, Iterator
from itertools import compress
from pathlib import Path

import numpy as np

from clsplat.blocks.parts import bounds_of, parts_of, read_part, seen_in
from clsplat.blocks.sight import seen
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer

BATCH = 16
"""Most cameras for which Gaussians are read together: each part is read once for them, not once for each."""

SHARE = 1 / 4
"""Most of the device's memory that the parameters of these Gaussians may take, if there is more than one camera. With
what rendering needs, they take two to three times as much (`clsplat.training.memory`)."""


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
        cameras = list(cameras)
        for first in range(0, len(cameras), BATCH):
            yield from self._shown(renderer, cameras[first : first + BATCH])

    def _shown(self, renderer: Renderer, cameras: list[Camera]) -> Iterator[tuple[list[Camera], Gaussians]]:
        gaussians = self._read(renderer, cameras)
        if gaussians is not None:
            yield cameras, gaussians
            return
        half = len(cameras) // 2
        yield from self._shown(renderer, cameras[:half])
        yield from self._shown(renderer, cameras[half:])

    def _read(self, renderer: Renderer, cameras: list[Camera]) -> Gaussians | None:
        """Read the Gaussians that cameras may show; None if there are several cameras, and too many Gaussians."""
        most = np.inf if renderer.device is None or len(cameras) == 1 else SHARE * renderer.device.memory_limit
        found, size = [self._none], 0
        for part in compress(self._parts, seen(cameras, bounds_of(self._parts), renderer.config)):
            gaussians = read_part(self._folder, part)
            found.append(gaussians.take(seen_in(part, gaussians, cameras, renderer.config)))
            size += sum(array.nbytes for array in found[-1].arrays().values())
            if size > most:
                return None
        return Gaussians.concatenate(found)
