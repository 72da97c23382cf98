"""The smallest version of a scene within a loss, or the best one within a size: pruned, with fewer bands.

How good a version is, is judged by views that did not price it. The loss is in decibels of PSNR, the mean over views
of 10 log10(e'/e) with the mean squared errors e before and e' after. Against photos both are measured. Against the
scene's own renders the first is unknown: it is taken as that of `ASSUMED_PSNR`, and e' = e + the mean squared
difference from the render, as if what is lost had nothing to do with what was wrong before.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from clsplat.config import RenderConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.metrics import psnr, to_uint8
from clsplat.pruning.prices import removal_order, with_degree
from clsplat.render import Color, render_views
from clsplat.scene import View

if TYPE_CHECKING:
    from clsplat.device import Device

Stored = Callable[[Gaussians], tuple[Gaussians, int]]
"""Gaussians as they come back from a file, and its bytes."""

ASSUMED_PSNR = 30.0
"""Decibels against photos that nobody has. Scenes of the original paper reach 27 (Mip-NeRF 360), 24 (Tanks and
Temples) and 29 (Deep Blending; its table 1): 30 is on the safe side."""

ROUNDING = 1 / 12 / 255**2
"""Mean squared error of rounding to 8 bits: no photo is known better."""

PRECISION = 1.02
"""To this factor the number of Gaussians is found."""

TRIES = 6
"""How often the loss that is aimed at is lowered by what the file's format adds."""


class Judge:
    """Loss of versions of a scene over views.

    Parameters
    ----------
    gaussians : Gaussians
        The scene as it was.
    views : list of View
        Photos, or its own renders.
    photos : bool
        Which.
    config, device, background
        As given to `clsplat.render.render`.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: list[View],
        photos: bool,
        config: RenderConfig,
        device: "Device | None",
        background: Color,
    ):
        self._views, self._config, self._device, self._background = views, config, device, background
        self._before = np.full(len(views), 10 ** (-ASSUMED_PSNR / 10))
        self._added = np.zeros(len(views)) if photos else self._before
        if photos:
            self._before = np.maximum(self._errors(gaussians), ROUNDING)

    def _errors(self, gaussians: Gaussians) -> np.ndarray:
        cameras = [view.camera for view in self._views]
        renderings = render_views(gaussians, cameras, self._config, self._device, background=self._background)
        pairs = zip(renderings, self._views, strict=True)
        return np.array([10 ** (-psnr(to_uint8(r.rgb), v.image, v.mask) / 10) for r, v in pairs])

    def __call__(self, gaussians: Gaussians) -> float:
        """Loss in decibels; negative where the version is nearer to the photos than the scene was."""
        after = np.maximum(self._errors(gaussians), ROUNDING if not self._added.any() else 0) + self._added
        return float(np.mean(10 * np.log10(after / self._before)))


class Compacted(NamedTuple):
    """A version of a scene: its Gaussians, the bytes of its file and the loss of what can be read from it."""

    gaussians: Gaussians
    size: int
    loss: float


@dataclass(frozen=True)
class Limits:
    """What a version may have at most: Gaussians, bytes, decibels of loss. None: anything."""

    gaussians: int | None = None
    size: int | None = None
    loss: float | None = None


def compact(
    gaussians: Gaussians,
    views: list[View],
    judge: Judge,
    limits: Limits,
    stored: Stored,
    config: RenderConfig = RenderConfig(),
    device: "Device | None" = None,
    background: Color = (0.0, 0.0, 0.0),
) -> Compacted:
    """Prune a scene and lower the degree of its spherical harmonics.

    Parameters
    ----------
    gaussians : Gaussians
    views : list of View
        Those that price; `judge` has others.
    judge : Judge
    limits : Limits
        With a loss, the smallest file is searched; else the smallest loss.
    stored : Stored
    config, device, background
        As given to `clsplat.render.render`.

    Returns
    -------
    Compacted

    Raises
    ------
    InputError
        If no version is within the limits; the message says which is nearest.
    """
    search = _Search(gaussians, judge, limits, stored)
    search.order = removal_order(gaussians, views, search.far_enough, config, device, background)
    if limits.loss is not None:
        return search.smallest(limits.loss)
    degrees = range(gaussians.sh_degree + 1) if limits.size is not None else [gaussians.sh_degree]
    versions = [search.judged(search.largest_number(degree), degree) for degree in degrees]
    return min(versions, key=lambda version: version.loss)


class _Search:
    """Versions of a scene by number of Gaussians and degree, and which of them is wanted."""

    order: np.ndarray

    def __init__(self, gaussians: Gaussians, judge: Judge, limits: Limits, stored: Stored):
        self._gaussians, self._judge, self._limits, self._stored = gaussians, judge, limits, stored
        self._bytes_each = stored(gaussians)[1] / len(gaussians)

    def far_enough(self, left: Gaussians) -> bool:
        """Whether pruning need not go on beyond what is left."""
        limits = self._limits
        if limits.loss is not None:
            return self._judge(left) > limits.loss
        most = [limits.gaussians, limits.size and limits.size / self._bytes_each]
        return len(left) <= min(m for m in most if m is not None)

    def version(self, n: int, degree: int) -> Gaussians:
        return with_degree(self._gaussians.take(np.sort(self.order[:n])), degree)

    def judged(self, n: int, degree: int) -> Compacted:
        version = self.version(n, degree)
        again, size = self._stored(version)
        return Compacted(version, size, self._judge(again))

    def largest_number(self, degree: int) -> int:
        """The number of Gaussians that the limits admit."""
        n = min(len(self._gaussians), self._limits.gaussians or len(self._gaussians))
        if self._limits.size is None:
            return n
        low, high = 0, n + 1  # fits, does not
        while high > low + 1 and (low == 0 or high / low > PRECISION):
            size = self._stored(self.version(n, degree))[1]
            low, high = (n, high) if size <= self._limits.size else (low, n)
            # Bytes are nearly in proportion to Gaussians.
            n = min(max(round(0.995 * n * self._limits.size / size), low + 1), high - 1)
        if low == 0:
            raise InputError(
                f"--max-bytes: expected enough for a Gaussian in this format, {size} bytes, found {self._limits.size}"
            )
        return low

    def smallest_number(self, degree: int, loss: float) -> int | None:
        """The number of Gaussians from which the loss is within a limit; None if it never is."""
        low, high = 0, len(self._gaussians)
        if self._judge(self.version(high, degree)) > loss:
            return None
        while high > low + 1 and (low == 0 or high / low > PRECISION):
            n = max(int(np.sqrt(low * high)), low + 1) if low else high // 2
            low, high = (n, high) if self._judge(self.version(n, degree)) > loss else (low, n)
        return high

    def smallest(self, limit: float) -> Compacted:
        """The smallest file whose loss, what the format rounds included, is within the limit."""
        numbers = {d: self.smallest_number(d, limit) for d in range(self._gaussians.sh_degree + 1)}
        sizes = {d: self._stored(self.version(n, d))[1] for d, n in numbers.items() if n is not None}
        degree, aim = min(sizes, key=lambda d: sizes[d]), limit
        for _ in range(TRIES):
            n = self.smallest_number(degree, aim)
            if n is None:
                break
            found = self.judged(n, degree)
            if found.loss <= limit:
                return self._within(found)
            aim -= found.loss - limit
            degree = degree if self.smallest_number(degree, aim) else min(degree + 1, self._gaussians.sh_degree)
        whole = self.judged(len(self._gaussians), self._gaussians.sh_degree)
        raise InputError(
            f"--max-psnr-loss: expected more than the {whole.loss:.3f} dB that the format costs without any pruning, "
            f"found {limit:g}; a format such as .sog or .ply loses less"
        )

    def _within(self, found: Compacted) -> Compacted:
        for flag, most, value in (
            ("--max-gaussians", self._limits.gaussians, len(found.gaussians)),
            ("--max-bytes", self._limits.size, found.size),
        ):
            if most is not None and value > most:
                raise InputError(
                    f"{flag}: expected at least {value}, for --max-psnr-loss {self._limits.loss:g} takes as many, "
                    f"found {most}"
                )
        return found
