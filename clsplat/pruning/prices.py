"""What each Gaussian, and each band of its spherical harmonics, is worth: its part in the error of rendered views.

By how much the error grows if one Gaussian alone is removed is known exactly (docs/stages/removal.md). Of many
removed together some hide what others left; so they go in rounds, after each of which what is left is priced anew.
And where the image is too bright, each of those that make it so promises a gain that only the first of them would
bring: an order by the error alone removes them all, and loses more from round to round. So nothing is cheaper than
the difference that its removal makes to the picture, but what would add to an error that is there already costs more.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.config import RenderConfig
from clsplat.constants import ALPHA_MIN
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.reference.sh import sh_basis
from clsplat.render import Color, download, forward, stage_functions, upload
from clsplat.scene import View
from clsplat.stages import Removal

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[np.float64]

ROUND = 0.85
"""Fraction of the Gaussians that a round of `removal_order` leaves. With half of a scene removed in rounds of 0.7
instead, the loss was 0.63 dB instead of 0.43 (fox_pinhole) and 0.24 instead of 0.21 (guitar, views of others), in
0.6 of the time."""


class Prices(NamedTuple):
    """What N Gaussians are worth to views: changes of the sum over the views of the mean squared error per pixel.

    errors (N,): if the Gaussian alone is removed; negative for one that does harm. differences (N,): the same if the
    render itself were the target. weights (N,): sums of its weight
    alpha T per pixel, 0 for what no view shows. bands (N, D): column d, if the Gaussian alone keeps the bands 0 to d
    of its spherical harmonics, whose degree is D.
    """

    errors: Array
    differences: Array
    weights: Array
    bands: Array

    @property
    def costs(self) -> Array:
        """(N,) What pruning goes by: the error, but of what makes a place too bright, each promises the same gain."""
        return np.maximum(self.errors, self.differences)


def price(
    gaussians: Gaussians,
    views: list[View],
    config: RenderConfig = RenderConfig(),
    device: "Device | None" = None,
    background: Color = (0.0, 0.0, 0.0),
    *,
    bands: bool = True,
) -> Prices:
    """Price Gaussians by views.

    Parameters
    ----------
    gaussians : Gaussians
        At least one, on the host.
    views : list of View
        Photos, or renders of the scene as it was at first; their masks count.
    config : RenderConfig
    device : Device, optional
        None prices with the float64 twins.
    background : (3,) floats
        RGB behind the Gaussians.
    bands : bool
        Whether the bands of the spherical harmonics are priced; their prices are 0 otherwise.

    Returns
    -------
    Prices

    Raises
    ------
    InputError
        If there is no view or no Gaussian.
    """
    if not views or not len(gaussians):
        raise InputError(f"views, gaussians: expected at least one each, found {len(views)} and {len(gaussians)}")
    n, degree = len(gaussians), gaussians.sh_degree
    total = Prices(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros((n, degree)))
    uploaded = upload(device, gaussians)
    behind = np.array(background)
    for view in views:
        run = forward(device, uploaded, view.camera, config, behind, degree)
        # What a screen shows: what exceeds white is no error.
        residuals = np.clip(download(run.image.image), 0, 1) - view.image / 255
        part: Removal = stage_functions(device).removal(run.splats, run.bins, behind, residuals, view.mask)
        pixels = residuals[:, :, 0].size if view.mask is None else max(1, int(view.mask.sum()))
        total.errors[:] += part.errors / pixels
        total.differences[:] += part.differences / pixels
        total.weights[:] += part.weights / pixels
        if degree and bands:
            seen = np.flatnonzero(part.weights > 0)
            change = _color_changes(gaussians.take(seen), view.camera.position)
            squares, pulls = part.squares[seen, None], part.pulls[seen]
            error = squares * (change**2).sum(axis=2) + 2 * np.einsum("ndc,nc->nd", change, pulls)
            total.bands[seen] += error / pixels
    return total


def _color_changes(gaussians: Gaussians, position: Array) -> Array:
    """(N, D, 3): what the colours seen from `position` change by if bands above d = 0 to D - 1 are dropped."""
    directions = gaussians.means - position
    directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    terms = sh_basis(directions, gaussians.sh_degree)[:, :, None] * gaussians.sh
    sums = np.cumsum(terms, axis=1)[:, [(d + 1) ** 2 - 1 for d in range(gaussians.sh_degree + 1)]]
    colors = np.maximum(0.5 + sums, 0)
    return np.asarray(colors[:, :-1] - colors[:, -1:], dtype=np.float64)


def removal_order(
    gaussians: Gaussians,
    views: list[View],
    until: Callable[[Gaussians], bool],
    config: RenderConfig = RenderConfig(),
    device: "Device | None" = None,
    background: Color = (0.0, 0.0, 0.0),
) -> NDArray[np.intp]:
    """The Gaussians from the one to keep longest to the first one to go.

    Parameters
    ----------
    gaussians, views, config, device, background
        As given to `price`.
    until : callable
        Told what is left after each round; true ends the rounds. Those left then are ordered by their prices of
        the last round.

    Returns
    -------
    (N,) int
        Rows: ``gaussians.take(order[:n])`` is the scene pruned to n. Ties go by index; the same input gives the
        same order.
    """
    kept = np.arange(len(gaussians))
    gone: list[NDArray[np.intp]] = []
    while True:
        prices = price(gaussians.take(kept), views, config, device, background, bands=False)
        kept = kept[np.argsort(-prices.costs, kind="stable")]
        left = int(ROUND * len(kept))
        if left == 0 or until(gaussians.take(np.sort(kept[:left]))):
            return np.concatenate([kept, *reversed(gone)])
        gone.append(kept[left:])
        kept = np.sort(kept[:left])


def without_invisible(gaussians: Gaussians) -> Gaussians:
    """The Gaussians without those of an opacity below ALPHA_MIN, which no pixel of any view shows; at least one."""
    shown = gaussians.opacities >= ALPHA_MIN
    shown[np.argmax(gaussians.logit_opacities)] = True
    return gaussians.take(shown)


def with_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The Gaussians with the bands 0 to `degree` of their spherical harmonics, at most those they have."""
    return replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])


def without_bands(gaussians: Gaussians, bands: Array, budget: float) -> Gaussians:
    """Zero the bands above some degree of each Gaussian, the cheapest first, while a sum of prices lasts.

    Parameters
    ----------
    gaussians : Gaussians
    bands : (N, D)
        Of `Prices` of the same Gaussians.
    budget : float
        Largest sum of the prices of what is dropped.

    Returns
    -------
    Gaussians
        Of the same degree: formats that compress profit from the zeros.
    """
    # The lowest degree first: a Gaussian that loses all its bands gives most.
    sh = gaussians.sh.copy()
    left, open_ = budget, np.ones(len(gaussians), dtype=bool)
    for degree in range(gaussians.sh_degree):
        candidates = np.flatnonzero(open_)
        candidates = candidates[np.argsort(bands[candidates, degree], kind="stable")]
        share = left / (gaussians.sh_degree - degree)
        sums = np.cumsum(np.maximum(bands[candidates, degree], 0))
        chosen = candidates[: int(np.searchsorted(sums, share, side="right"))]
        sh[chosen, (degree + 1) ** 2 :] = 0
        open_[chosen] = False
        left -= float(sums[len(chosen) - 1]) if len(chosen) else 0.0
    return replace(gaussians, sh=sh)
