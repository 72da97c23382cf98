"""Reductions: versions of a scene with ever fewer Gaussians, by removing single ones and merging pairs.

Both save one Gaussian. Rounds choose the cheapest of both. The price of a removal is exact; the cost of a merge is
estimated for all neighbours (`merge_costs`), and measured for the pairs that seem cheapest: they are all merged at
once, and the change of each pixel is shared among the merged Gaussians in proportion to their weights there.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import Gaussians
from clsplat.pruning.merging import least_costs, merge_costs, merged_as_seen, neighbours
from clsplat.pruning.prices import ROUND, Prices, price
from clsplat.renderer import Renderer, download
from clsplat.scene import View

Array = NDArray[Any]


MARGIN = 2
"""Factor of the measured cost of a merge. A part of the change of its pixels is ascribed to other merges, and the
cheapest merges are those for which this part is large."""


class Reduction(NamedTuple):
    """Versions of a scene, each with one Gaussian less than the one before.

    pool: the Gaussians of the scene, followed by the merged ones. parents (M, 2): rows of the pool that each merged
    one replaces. birth, death (P,): a version with n Gaussians less than the scene has those with birth <= n < death.
    """

    pool: Gaussians
    parents: Array
    birth: Array
    death: Array

    def rows(self, n: int) -> NDArray[np.intp]:
        """Rows of the pool of the version with n Gaussians."""
        step = len(self.pool) - len(self.parents) - n
        return np.flatnonzero((self.birth <= step) & (step < self.death))


def reduce(
    gaussians: Gaussians, views: list[View], until: Callable[[Gaussians], bool], renderer: Renderer
) -> Reduction:
    """Remove and merge Gaussians in rounds, each of which prices those that are left.

    Parameters
    ----------
    gaussians, views, renderer
        As given to `price`.
    until : callable
        Called with the Gaussians that are left after each round; true ends the rounds. The smaller versions have the
        Gaussians of the highest prices.

    Returns
    -------
    Reduction
        The same input gives the same versions.
    """
    n = len(gaussians)
    pool, parents = gaussians, np.zeros((0, 2), np.intp)
    birth, death = np.zeros(n, np.intp), np.full(n, n)
    alive, known, step = np.arange(n), np.zeros(n), 0
    while len(alive) > 1:
        current = pool.take(alive)
        prices = price(current, views, renderer, bands=False)
        count = len(alive) - int(ROUND * len(alive))
        pairs, costs = _measured_merges(current, prices, count, views, renderer)
        removed, joined = cheapest(prices.costs, pairs, costs, count)
        order = np.concatenate([prices.costs[removed], costs[joined]]).argsort(kind="stable")
        steps = np.empty(count, np.intp)
        steps[order] = step + 1 + np.arange(count)
        death[alive[removed]] = steps[: len(removed)]
        replaced = alive[pairs[joined]]
        death[replaced] = steps[len(removed) :, None]
        step += count
        new = len(pool) + np.arange(len(joined))
        pool = Gaussians.concatenate([pool, merged_as_seen(current, pairs[joined], prices)])
        parents = np.concatenate([parents, replaced])
        birth = np.concatenate([birth, steps[len(removed) :]])
        death = np.concatenate([death, np.full(len(joined), n)])
        known = np.full(len(pool), np.inf)
        known[alive] = prices.costs
        alive = np.concatenate([alive[death[alive] == n], new])
        if until(pool.take(alive)):
            break
    last = alive[np.argsort(known[alive], kind="stable")]
    death[last] = step + 1 + np.arange(len(last))
    return Reduction(pool, parents, birth, death)


def cheapest(removals: Array, pairs: Array, merges: Array, count: int) -> tuple[Array, Array]:
    """Choose the cheapest removals and merges that together save `count` Gaussians.

    Parameters
    ----------
    removals : (N,)
        Cost of removing each Gaussian.
    pairs : (P, 2) int
        Gaussians that may be merged.
    merges : (P,)
        Cost of merging each pair.
    count : int
        At most N.

    Returns
    -------
    removed : (R,) int
        Gaussians to remove.
    joined : (J,) int
        Pairs to merge; no Gaussian has two parts. R + J is `count`.
    """
    n, used = len(removals), np.zeros(len(removals), bool)
    removed: list[int] = []
    joined: list[int] = []
    for i in np.argsort(np.concatenate([removals, merges]), kind="stable"):
        if len(removed) + len(joined) == count:
            break
        parts = [i] if i < n else pairs[i - n]
        if used[parts].any():
            continue
        used[parts] = True
        (removed if i < n else joined).append(i if i < n else i - n)
    return np.array(removed, np.intp), np.array(joined, np.intp)


def _measured_merges(
    gaussians: Gaussians, prices: Prices, count: int, views: list[View], renderer: Renderer
) -> tuple[Array, Array]:
    """Pairs (P, 2) whose merge seems cheaper than the removals of a round, at most `count`, and their costs."""
    dearest = np.sort(prices.costs)[count - 1]
    pairs = neighbours(gaussians)
    # Removing one of two is cheaper than merging them if its price is low.
    pairs = pairs[prices.costs[pairs].min(axis=1) > dearest]
    pairs = pairs[least_costs(gaussians, pairs, prices) < dearest]
    estimates = merge_costs(gaussians, pairs, prices)
    never = np.full(len(gaussians), np.inf)
    chosen = cheapest(never, pairs, np.where(estimates < dearest, estimates, np.inf), min(count, len(gaussians) // 2))
    pairs = pairs[chosen[1][estimates[chosen[1]] < dearest]]
    if not len(pairs):
        return pairs, np.zeros(0)
    others = np.ones(len(gaussians), bool)
    others[pairs] = False
    tentative = Gaussians.concatenate([merged_as_seen(gaussians, pairs, prices), gaussians.take(others)])
    return pairs, MARGIN * _shares(gaussians, tentative, len(pairs), views, renderer)


def _shares(before: Gaussians, after: Gaussians, count: int, views: list[View], renderer: Renderer) -> Array:
    """Share the change of the views among the first `count` Gaussians of `after`, by their weights in each pixel."""
    shares, total = np.zeros(count), 0.0
    background = np.array(renderer.background)
    for view in views:
        # One after the other: both scenes have the same buffers on the device.
        old = np.clip(download(renderer.forward(before, view.camera, gradients=False).image.rgb), 0, 1)
        run = renderer.forward(after, view.camera)
        change = ((np.clip(download(run.image.rgb), 0, 1) - old) ** 2).sum(axis=2)
        counts = view.counts
        residuals = np.repeat(change[:, :, None], 3, axis=2)
        pulls = renderer.stages.removal(run.drawn, run.bins, background, residuals, view.mask).pulls
        shares += pulls[:count, 0] / max(1, counts.sum())
        total += float(change[counts].sum()) / max(1, counts.sum())
    # What falls on other Gaussians is shared as well.
    return shares * (total / shares.sum()) if shares.sum() > 0 else shares
