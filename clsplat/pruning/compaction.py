"""Compaction: the smallest version of a scene within a loss, or the best one within a number of bytes or Gaussians.

A version has fewer Gaussians, and spherical harmonics of a lower degree or of fewer different kinds. Its loss is
measured in views that did not price the Gaussians: decibels of PSNR, the mean over views of 10 log10(e'/e) with the
mean squared errors e before and e' after. With photos both errors are measured. With the scene's own renders e is
unknown: it is taken from `ASSUMED_PSNR`, and e' = e + the mean squared difference from the render, as if the two
errors were independent.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from clsplat.errors import InputError
from clsplat.formats.codebook import PALETTE_MAX
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.pruning.harmonics import curvatures, fitted_degree, with_shared_bands
from clsplat.pruning.reductions import Reduction, reduce
from clsplat.render import renderings
from clsplat.renderer import Renderer
from clsplat.scene import View, in_turn

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


PALETTE_PARTS = (128, 32, 8)
"""Mean numbers of Gaussians that share their harmonics above band 0, which are tried if the format gains by it
(measured: docs/howto/compact.md)."""

SHARING_MIN = 0.1
"""Fraction of a file that must disappear if all harmonics above band 0 are equal, for palettes to be tried."""


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
        pairs = zip(renderings(self._renderer, gaussians, cameras), in_turn(self._views), strict=True)
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
    """Reduce the number of Gaussians of a scene, and the degree or the number of its spherical harmonics.

    Parameters
    ----------
    gaussians : Gaussians
    views : list of View
        Views that price the Gaussians; `loss` has others.
    loss : LossMeter
    limits : Limits
        With a limit of the loss, the result is the smallest file within it; otherwise the version of the smallest
        loss.
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
    goal = _Goal(gaussians, loss, limits, stored)
    reduction = reduce(gaussians, views, goal.far_enough, renderer)
    choices = [reduction.pool]
    if limits.loss is not None or limits.bytes is not None:
        choices = choices_of(gaussians, reduction, views, goal.degree, goal.sharing_pays(), renderer)
    search = _Search(goal, reduction, choices)
    if limits.loss is not None:
        return search.smallest(limits.loss)
    versions = [search.measured(search.largest_number(choice), choice) for choice in range(len(choices))]
    return min(versions, key=lambda version: version.loss)


def choices_of(
    gaussians: Gaussians, reduction: Reduction, views: list[View], highest: int, sharing: bool, renderer: Renderer
) -> list[Gaussians]:
    """The Gaussians of a reduction with cheaper harmonics, from the coarsest to the original ones.

    Parameters
    ----------
    gaussians, views, renderer
        As given to `reduce`.
    reduction : Reduction
    highest : int
        Highest degree of the spherical harmonics that the format stores.
    sharing : bool
        Whether Gaussians that share their harmonics save bytes; otherwise lower degrees are offered.

    Returns
    -------
    list of Gaussians
        Each has the rows of `reduction.pool`.
    """
    pool, n = reduction.pool, len(gaussians)
    if not pool.sh_degree:
        return [pool]
    own = curvatures(gaussians, views, renderer)
    curvature = np.concatenate([own, np.empty((len(pool) - n, own.shape[1]), np.float32)])
    for row, pair in enumerate(reduction.parents, n):
        curvature[row] = curvature[pair].sum(axis=0)
    highest = min(highest, pool.sh_degree)
    degrees = range(1) if sharing else range(highest + 1)
    sizes = [min(max(n // part, 1), PALETTE_MAX) for part in PALETTE_PARTS] if sharing else []
    return [
        *(fitted_degree(pool, curvature, degree) for degree in degrees if degree < pool.sh_degree),
        *(with_shared_bands(pool, curvature, size) for size in sizes),
        *([pool] if highest == pool.sh_degree else []),
    ]


class _Goal:
    """What a compaction is to reach: a scene, its limits, and how loss and bytes are measured; degree: the highest
    one of the harmonics that the format stores."""

    def __init__(self, gaussians: Gaussians, loss: LossMeter, limits: Limits, stored: Stored):
        self.gaussians, self.loss, self.limits, self.stored = gaussians, loss, limits, stored
        again, self._bytes = stored(gaussians)
        self.degree = again.sh_degree

    def sharing_pays(self) -> bool:
        """Whether the file becomes smaller if Gaussians share their harmonics."""
        sh = self.gaussians.sh.copy()
        sh[:, 1:] = 0
        return self.stored(replace(self.gaussians, sh=sh))[1] < (1 - SHARING_MIN) * self._bytes

    def far_enough(self, left: Gaussians) -> bool:
        """Whether the reduction can stop at the Gaussians that are left."""
        limits = self.limits
        if limits.loss is not None:
            return self.loss(left) > limits.loss
        most = [limits.gaussians, limits.bytes and limits.bytes / self._bytes * len(self.gaussians)]
        return len(left) <= min(m for m in most if m is not None)


class _Search:
    """Search among versions of a scene, by number of Gaussians and choice of harmonics."""

    def __init__(self, goal: _Goal, reduction: Reduction, choices: list[Gaussians]):
        self._gaussians, self._loss, self._limits, self._stored = goal.gaussians, goal.loss, goal.limits, goal.stored
        self._reduction, self._choices = reduction, choices

    def version(self, n: int, choice: int) -> Gaussians:
        return self._choices[choice].take(self._reduction.rows(n))

    def measured(self, n: int, choice: int) -> Compacted:
        version = self.version(n, choice)
        again, size = self._stored(version)
        return Compacted(version, size, self._loss(again))

    def largest_number(self, choice: int) -> int:
        """The largest number of Gaussians within the limits."""
        n = min(len(self._gaussians), self._limits.gaussians or len(self._gaussians))
        if self._limits.bytes is None:
            return n
        low, high = 0, n + 1  # fits, does not
        while high > low + 1 and (low == 0 or high / low > PRECISION):
            size = self._stored(self.version(n, choice))[1]
            low, high = (n, high) if size <= self._limits.bytes else (low, n)
            # Bytes are nearly in proportion to Gaussians.
            n = min(max(round(0.995 * n * self._limits.bytes / size), low + 1), high - 1)
        if low == 0:
            raise InputError(
                f"--max-bytes: expected at least {size}, the bytes of one Gaussian in this format, "
                f"found {self._limits.bytes}"
            )
        return low

    def smallest_number(self, choice: int, loss: float) -> int | None:
        """The smallest number of Gaussians whose loss is within a limit; None if there is none."""
        low, high = 0, len(self._gaussians)
        if self._loss(self.version(high, choice)) > loss:
            return None
        while high > low + 1 and (low == 0 or high / low > PRECISION):
            n = max(int(np.sqrt(low * high)), low + 1) if low else high // 2
            low, high = (n, high) if self._loss(self.version(n, choice)) > loss else (low, n)
        return high

    def smallest(self, limit: float) -> Compacted:
        """The smallest file whose loss, rounding by the format included, is within the limit."""
        last, most = len(self._choices) - 1, self._limits.gaussians
        numbers = {c: n for c in range(last + 1) if (n := self.smallest_number(c, limit)) is not None}
        # Cheaper harmonics may need more Gaussians than the limit.
        allowed = {c: n for c, n in numbers.items() if most is None or n <= most}
        sizes = {c: self._stored(self.version(n, c))[1] for c, n in allowed.items()}
        choice, aim = min(sizes or numbers, key=lambda c: (sizes or numbers)[c], default=last), limit
        for _ in range(TRIES):
            n = self.smallest_number(choice, aim)
            if n is None:
                break
            found = self.measured(n, choice)
            if found.loss <= limit:
                return self._within(found)
            # Below the loss of this version before rounding: the search does not find it again.
            aim = self._loss(found.gaussians) - (found.loss - limit)
            choice = choice if self.smallest_number(choice, aim) else min(choice + 1, last)
        whole = self.measured(len(self._gaussians), last)
        if whole.loss <= limit:
            return self._within(whole)
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
