"""Compaction: the smallest version of a scene within a loss, or the best one within a number of bytes or Gaussians.

A version has fewer Gaussians and fewer bands of spherical harmonics. Its loss is measured in views that did not price
the Gaussians: decibels of PSNR, the mean over views of 10 log10(e'/e) with the mean squared errors e before and e'
after. With photos both errors are measured. With the scene's own renders e is unknown: it is taken from
`ASSUMED_PSNR`, and e' = e + the mean squared difference from the render, as if the two errors were independent.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.pruning.prices import removal_order, with_degree
from clsplat.render import renderings
from clsplat.renderer import Renderer
from clsplat.scene import View

Stored = Callable[[Gaussians], tuple[Gaussians, int]]
"""Write Gaussians to a file and read them back; return them with the bytes of the file."""

ASSUMED_PSNR = 30.0
"""PSNR of a scene against unknown photos, dB. Scenes of the original paper reach 24 to 29 (its table 1); a larger
value overestimates the loss."""

ROUNDING = 1 / 12 / 255**2
"""Mean squared error of rounding to 8 bits, the smallest error of a photo."""

PRECISION = 1.02
"""Factor to which the number of Gaussians is found."""

TRIES = 6
"""Number of times that the target loss is lowered by the loss that the file format adds."""


class LossMeter:
    """Loss of versions of a scene over views.

    Parameters
    ----------
    gaussians : Gaussians
        The scene before compaction.
    views : list of View
        Photos, or renders of the scene.
    photos : bool
        Whether `views` are photos.
    renderer : Renderer
    """

    def __init__(self, gaussians: Gaussians, views: list[View], photos: bool, renderer: Renderer):
        self._views, self._renderer = views, renderer
        self._before = np.full(len(views), 10 ** (-ASSUMED_PSNR / 10))
        self._added = np.zeros(len(views)) if photos else self._before
        if photos:
            self._before = np.maximum(self._errors(gaussians), ROUNDING)

    def _errors(self, gaussians: Gaussians) -> np.ndarray:
        cameras = [view.camera for view in self._views]
        pairs = zip(renderings(self._renderer, gaussians, cameras), self._views, strict=True)
        return np.array([10 ** (-psnr(to_uint8(r.rgb), v.image, v.mask) / 10) for r, v in pairs])

    def __call__(self, gaussians: Gaussians) -> float:
        """Loss in decibels; negative if the version is closer to the photos than the scene was."""
        after = np.maximum(self._errors(gaussians), ROUNDING if not self._added.any() else 0) + self._added
        return float(np.mean(10 * np.log10(after / self._before)))


class Compacted(NamedTuple):
    """A version of a scene: its Gaussians, the bytes of its file, and the loss in dB of the scene read from the
    file."""

    gaussians: Gaussians
    bytes: int
    loss: float


@dataclass(frozen=True)
class Limits:
    """Upper limits of a version: Gaussians, bytes of its file, loss in dB. None: no limit."""

    gaussians: int | None = None
    bytes: int | None = None
    loss: float | None = None


def compact(
    gaussians: Gaussians,
    views: list[View],
    loss: LossMeter,
    limits: Limits,
    stored: Stored,
    renderer: Renderer,
) -> Compacted:
    """Prune a scene and lower the degree of its spherical harmonics.

    Parameters
    ----------
    gaussians : Gaussians
    views : list of View
        Views that price the Gaussians; `loss` has others.
    loss : LossMeter
    limits : Limits
        With a limit of the loss the smallest file is searched, otherwise the smallest loss.
    stored : Stored
    renderer : Renderer

    Returns
    -------
    Compacted

    Raises
    ------
    InputError
        If no version is within the limits; the message names the nearest one.
    """
    search = _Search(gaussians, loss, limits, stored)
    search.order = removal_order(gaussians, views, search.far_enough, renderer)
    if limits.loss is not None:
        return search.smallest(limits.loss)
    degrees = range(gaussians.sh_degree + 1) if limits.bytes is not None else [gaussians.sh_degree]
    versions = [search.measured(search.largest_number(degree), degree) for degree in degrees]
    return min(versions, key=lambda version: version.loss)


class _Search:
    """Search among versions of a scene, by number of Gaussians and degree."""

    order: np.ndarray

    def __init__(self, gaussians: Gaussians, loss: LossMeter, limits: Limits, stored: Stored):
        self._gaussians, self._loss, self._limits, self._stored = gaussians, loss, limits, stored
        self._bytes_each = stored(gaussians)[1] / len(gaussians)

    def far_enough(self, left: Gaussians) -> bool:
        """Whether pruning can stop at the Gaussians that are left."""
        limits = self._limits
        if limits.loss is not None:
            return self._loss(left) > limits.loss
        most = [limits.gaussians, limits.bytes and limits.bytes / self._bytes_each]
        return len(left) <= min(m for m in most if m is not None)

    def version(self, n: int, degree: int) -> Gaussians:
        return with_degree(self._gaussians.take(np.sort(self.order[:n])), degree)

    def measured(self, n: int, degree: int) -> Compacted:
        version = self.version(n, degree)
        again, size = self._stored(version)
        return Compacted(version, size, self._loss(again))

    def largest_number(self, degree: int) -> int:
        """The largest number of Gaussians within the limits."""
        n = min(len(self._gaussians), self._limits.gaussians or len(self._gaussians))
        if self._limits.bytes is None:
            return n
        low, high = 0, n + 1  # fits, does not
        while high > low + 1 and (low == 0 or high / low > PRECISION):
            size = self._stored(self.version(n, degree))[1]
            low, high = (n, high) if size <= self._limits.bytes else (low, n)
            # Bytes are nearly in proportion to Gaussians.
            n = min(max(round(0.995 * n * self._limits.bytes / size), low + 1), high - 1)
        if low == 0:
            raise InputError(
                f"--max-bytes: expected at least {size}, the bytes of one Gaussian in this format, "
                f"found {self._limits.bytes}"
            )
        return low

    def smallest_number(self, degree: int, loss: float) -> int | None:
        """The smallest number of Gaussians whose loss is within a limit; None if there is none."""
        low, high = 0, len(self._gaussians)
        if self._loss(self.version(high, degree)) > loss:
            return None
        while high > low + 1 and (low == 0 or high / low > PRECISION):
            n = max(int(np.sqrt(low * high)), low + 1) if low else high // 2
            low, high = (n, high) if self._loss(self.version(n, degree)) > loss else (low, n)
        return high

    def smallest(self, limit: float) -> Compacted:
        """The smallest file whose loss, rounding by the format included, is within the limit."""
        numbers = {d: self.smallest_number(d, limit) for d in range(self._gaussians.sh_degree + 1)}
        sizes = {d: self._stored(self.version(n, d))[1] for d, n in numbers.items() if n is not None}
        degree, aim = min(sizes, key=lambda d: sizes[d]), limit
        for _ in range(TRIES):
            n = self.smallest_number(degree, aim)
            if n is None:
                break
            found = self.measured(n, degree)
            if found.loss <= limit:
                return self._within(found)
            aim -= found.loss - limit
            degree = degree if self.smallest_number(degree, aim) else min(degree + 1, self._gaussians.sh_degree)
        whole = self.measured(len(self._gaussians), self._gaussians.sh_degree)
        raise InputError(
            f"--max-psnr-loss: expected more than the {whole.loss:.3f} dB that the format costs without any pruning, "
            f"found {limit:g}; a format such as .sog or .ply loses less"
        )

    def _within(self, found: Compacted) -> Compacted:
        for flag, most, value in (
            ("--max-gaussians", self._limits.gaussians, len(found.gaussians)),
            ("--max-bytes", self._limits.bytes, found.bytes),
        ):
            if most is not None and value > most:
                raise InputError(
                    f"{flag}: expected at least {value}, which --max-psnr-loss {self._limits.loss:g} needs, "
                    f"found {most}"
                )
        return found
