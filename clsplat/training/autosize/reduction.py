"""Reductions that the search tries: fewer Gaussians, fewer bands of spherical harmonics."""

from dataclasses import replace
from math import ceil
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.pruning.prices import price, removal_order, without_bands
from clsplat.render import renderings
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.training.autosize.validation import split, validate

PRICING = 24
PRICING_SHARE = 1 / 5
"""Photos by which Gaussians are priced: this number of them, or of many photos this fraction. A Gaussian that few
photos show has no price in the others."""

BAND_SHARES = (1, 1 / 2, 1 / 4, 1 / 8, 1 / 16)
"""Fractions, tried in turn, of the bands that seem useless one by one (measured: docs/experiments/size.md)."""

T = TypeVar("T")


def some(views: list[T]) -> list[T]:
    """Evenly spaced views, as many as price."""
    return views[:: ceil(len(views) / max(PRICING, PRICING_SHARE * len(views)))]


def costliest_rows(gaussians: Gaussians, left: float, views: list[View], renderer: Renderer) -> NDArray[np.intp]:
    """Rows, in their order, of the fraction `left` of the Gaussians that is removed last."""
    n = max(1, int(left * len(gaussians)))
    order = removal_order(gaussians, unvalidated(gaussians, views, renderer), lambda g: len(g) <= n, renderer)
    return np.sort(order[:n])


def unvalidated(gaussians: Gaussians, views: list[View], renderer: Renderer) -> list[View]:
    """Some photos to price Gaussians by, with the render itself in place of those that are held back.

    Gaussians that are visible only there then have a price, but these photos have no part in it.
    """
    held, priced = split(views)[1], some(views)
    renders = iter(renderings(renderer, gaussians, [view.camera for view in priced if view in held]))
    return [replace(v, image=to_uint8(next(renders).rgb)) if v in held else v for v in priced]


def without_useless_bands(gaussians: Gaussians, views: list[View], renderer: Renderer) -> Gaussians:
    """Zero, per Gaussian, bands of the spherical harmonics whose removal makes the renders no worse.

    Each band is priced alone. Of those that seem useless the cheapest fraction is removed, and the fraction is halved
    until the mean quality of the photos does not fall.
    """
    priced = some(views)
    bands, degree = price(gaussians, priced, renderer).bands, gaussians.sh_degree
    before = np.mean(validate(gaussians, priced, renderer, degree))
    useless = bands[bands <= 0]
    for share in BAND_SHARES if len(useless) else ():
        fewer = without_bands(gaussians, bands - np.quantile(useless, share), 0.0)
        if np.mean(validate(fewer, priced, renderer, degree)) >= before:
            return fewer
    return gaussians
