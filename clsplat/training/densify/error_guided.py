"""Growth to a cap where the photos' errors are, away from where Gaussians do the least good."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import TrainConfig
from clsplat.gaussians import Gaussians, logit
from clsplat.reference.project import rotations
from clsplat.training.densify.schedule import Schedule
from clsplat.training.densify.strategy import Edit, Strategy, Survey

Array = NDArray[Any]

# The two children along the longest axis, in units of the parent's scale there: they keep its variance along the
# axis, CHILD_SCALE^2 + CHILD_OFFSET^2 = 1, and by CHILD_OPACITY the integral of its opacity.
CHILD_SCALE = 0.6
CHILD_OFFSET = 0.8
CHILD_OPACITY = 1 / (2 * CHILD_SCALE)

HARM = 1.0
"""Gaussians go while others grow if the error would fall by this many even shares of it. None of them would leave the
fog of a random start (lego, 200x200: 28.7 dB in the place of 30.3); at 0.2 fox_pinhole loses 0.25 dB."""

SHARE_MIN = 0.1
"""Of the training photos, how many must be surveyed for any to make room: what few photos show looks useless in most
surveys. bonsai by 10 of its 255 photos (199x133, 2000 iterations, 150 000 Gaussians): 28.8 dB if they do and 29.5 if
not. lego's 100 photos all show the same thing."""


class ErrorGuided(Strategy):
    """Splits the Gaussians to which most of the squared error of photos falls.

    A pixel's error is shared out among the Gaussians by the weights with which they are composited (Rota Bulò et
    al. 2024, "Revising densification in Gaussian splatting"). Those with the largest sums over some photos are split
    along their longest axis (Deng et al. 2025, "Improving densification in 3D Gaussian splatting", have such a split;
    the children here keep the parent's moments), as many as a budget allows (Mallick et al. 2024, "Taming 3DGS"). At
    the cap, those make room whose removal would do the least harm to the photos, or even good: each has the price
    that the stage removal finds. It remembers nothing between iterations.
    """

    start_opacity = 0.5  # as mcmc; measured 0.15 dB better than 0.1 on fox_pinhole

    def __init__(self, config: TrainConfig, extent: float, n: int) -> None:
        super().__init__(config, extent, n)
        self.config, self.schedule = config.error, Schedule(config, config.error)

    def due(self, iteration: int) -> bool:
        """See `clsplat.training.densify.Strategy`."""
        return self.schedule.due(iteration)

    def edit(self, iteration: int, gaussians: Gaussians, survey: Survey) -> Edit:
        """See `clsplat.training.densify.Strategy`."""
        n = len(gaussians)
        weights, errors, prices, share = survey(self.config.views)
        target = self.schedule.size_after(iteration, n, self.max_gaussians)
        doomed = gaussians.opacities <= self.config.opacity_min
        # What no photo of the survey shows may be needed by the others.
        seen = np.flatnonzero((weights > 0) & (share >= SHARE_MIN))
        full = target >= self.max_gaussians
        harmful = (prices[seen] <= (0 if full else -HARM * errors.sum() / n)).sum()
        count = np.clip(harmful, self.config.replaced * n if full else 0, self.config.replaced_most * n)
        doomed[seen[np.argsort(prices[seen], kind="stable")[: int(count)]]] = True
        live = np.flatnonzero(~doomed)
        if len(live) == 0:
            return Edit(gaussians, np.arange(n), np.zeros(n, bool))
        wanted = max(0, target - len(live))
        blamed = live[np.argsort(-errors[live], kind="stable")[:wanted]]
        parents = np.sort(blamed[errors[blamed] > 0])
        kept = np.setdiff1d(live, parents)
        result = Gaussians.concatenate([gaussians.take(kept), *split(gaussians.take(parents))])
        rows = np.concatenate([kept, parents, parents])
        return Edit(result, rows, np.arange(len(rows)) >= len(kept))


def split(parents: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Two children for each of N Gaussians, side by side on its longest axis."""
    rows = np.arange(len(parents))
    longest = parents.log_scales.argmax(axis=1)
    axes = rotations(parents.quats / np.linalg.norm(parents.quats, axis=1, keepdims=True))[rows, :, longest]
    offsets = CHILD_OFFSET * parents.scales[rows, longest][:, None] * axes
    children = parents.take(rows), parents.take(rows)
    for child, sign in zip(children, (1, -1), strict=True):
        child.means = (child.means + sign * offsets).astype(parents.means.dtype)
        child.log_scales[rows, longest] += np.log(CHILD_SCALE)
        child.logit_opacities = logit(CHILD_OPACITY * parents.opacities).astype(parents.means.dtype)
    return children
