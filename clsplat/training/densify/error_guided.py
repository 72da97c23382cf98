"""Error-guided densification: growth where the photos' errors are, removal where Gaussians contribute least."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import TrainConfig
from clsplat.gaussians import Gaussians, logit
from clsplat.reference.project import rotations
from clsplat.training.densify.schedule import WINDOW, Schedule
from clsplat.training.densify.strategy import Contributions, Edit, Strategy, Survey

Array = NDArray[Any]

CHILD_SCALE = 0.6
CHILD_OFFSET = 0.8
"""Scale and offset of the two children of a split along the longest axis, in units of the parent's scale there. They
keep its variance along the axis: CHILD_SCALE^2 + CHILD_OFFSET^2 = 1."""

CHILD_OPACITY = 1 / (2 * CHILD_SCALE)
"""Factor on the opacity of the children, which keeps the integral of the parent's opacity."""

OTHERS = 8
"""Number k of other removals with the same effect on the image that a price allows for. If d is that effect, and r
the render less the photo, k + 1 of them change the squared error by 2 r d + (k + 1) d^2 each: the price of one alone,
2 r d + d^2, and k times the difference d^2 (measured: docs/experiments/strategies.md)."""

MEMORY = 0.9
"""Factor per round on the differences of earlier surveys. Ten rounds, which survey 100 photos, leave a third."""

SURVEYED = 0.1
"""Least fraction of the training photos in a survey: the rounds of growth then show most of many photos."""

HARM = 1.0
"""Fall of the error, in even shares of it, above which Gaussians are removed while others grow (measured:
docs/experiments/strategies.md)."""

TOLL = 1.0
"""Deduction from the price for each pair of the Gaussian and a pixel, in even shares of the squared error per pair:
compositing takes the same time for every pair (measured: docs/experiments/strategies.md)."""

PRICED_PHOTOS = 100
"""Most training photos with which Gaussians are removed by price: of many photos, a Gaussian that few of them show
seems useless in most surveys (measured: docs/experiments/strategies.md)."""


class ErrorGuided(Strategy):
    """Split the Gaussians that have the largest part in the squared error of photos.

    A pixel's error is divided among the Gaussians by their compositing weights (Rota Bulò et al. 2024, "Revising
    densification in Gaussian splatting"). Those with the largest sums over some photos are split along their longest
    axis (Deng et al. 2025, "Improving densification in 3D Gaussian splatting", have such a split; the children here
    keep the parent's moments), up to a budget (Mallick et al. 2024, "Taming 3DGS"). At the cap, the Gaussians whose
    removal raises the error least for the pixels that they cover make room for others; their prices come from the
    stage removal.

    Statistics: differences (N,), the largest that the removal of a Gaussian made to the photos of a survey; earlier
    surveys count less. They keep what only photos outside the present survey show.
    """

    leaves_room = True

    def __init__(self, config: TrainConfig, extent: float, n: int) -> None:
        super().__init__(config, extent, n)
        # The second round in a window is for caps that the first one, which doubles at most, does not reach.
        growing = config.error.every or max(1, round(WINDOW * config.iterations) // 2)
        every = config.error.every or 2 * growing  # a multiple, so that `due` knows each round
        self.config, self.schedule = config.error, Schedule(config, config.error, growing, every)
        self.last = config.iterations - self.schedule.growing
        self.statistics = {"differences": np.zeros(n, np.float32)}

    def penalties(self, n: int) -> tuple[float, float]:
        """See `clsplat.training.densify.Strategy`."""
        return self.config.opacity_penalty / n, 0.0

    def due(self, iteration: int) -> bool:
        """See `clsplat.training.densify.Strategy`."""
        # After the last round, too, Gaussians that reach a viewpoint are shrunk. The last time leaves an interval to
        # train what has become smaller.
        schedule = self.schedule
        return schedule.start <= iteration <= self.last and (iteration - schedule.full) % schedule.growing == 0

    def edit(self, iteration: int, gaussians: Gaussians, cap: int, survey: Survey) -> Edit:
        """See `clsplat.training.densify.Strategy`."""
        n = len(gaussians)
        if not self.schedule.due(iteration):
            return Edit(gaussians, np.arange(n), np.zeros(n, bool))
        seen = survey(self.config.views, SURVEYED)
        errors = seen.errors
        known = np.maximum(seen.differences, MEMORY * self.statistics["differences"])
        target = self.schedule.count_after(iteration, n, cap)
        doomed = gaussians.opacities <= self.config.opacity_min
        doomed[self._removed_by_price(seen, known, target >= cap)] = True
        live = np.flatnonzero(~doomed)
        if len(live) == 0:
            self.statistics = {"differences": known.astype(np.float32)}
            return Edit(gaussians, np.arange(n), np.zeros(n, bool))
        wanted = max(0, target - len(live))
        blamed = live[np.argsort(-errors[live], kind="stable")[:wanted]]
        parents = np.sort(blamed[errors[blamed] > 0])
        doomed[parents] = True
        kept = np.flatnonzero(~doomed)
        result = Gaussians.concatenate([gaussians.take(kept), *split(gaussians.take(parents))])
        rows = np.concatenate([kept, parents, parents])
        fresh = np.arange(len(rows)) >= len(kept)
        # A child has half of the parent's effect on the image, and a quarter of its square.
        self.statistics = {"differences": np.where(fresh, known[rows] / 4, known[rows]).astype(np.float32)}
        return Edit(result, rows, fresh)

    def _removed_by_price(self, seen: Contributions, known: Array, full: bool) -> Array:
        """Rows of the Gaussians that are removed by their prices, with the largest differences known of each.

        How many is decided by the prices, and which by the prices less the tolls.
        """
        # Of many that are too bright in one place, each alone promises the gain that only the first removal brings.
        prices, error = seen.prices + OTHERS * known, seen.errors.sum()
        tolls = TOLL * error / max(seen.pairs.sum(), 1) * seen.pairs
        # Gaussians that no photo of the survey shows may be needed by the others.
        rows = np.flatnonzero((seen.weights > 0) & (seen.photos <= PRICED_PHOTOS))
        n = len(prices)
        harmful = (prices[rows] <= (0 if full else -HARM * error / n)).sum()
        count = np.clip(harmful, self.config.replaced * n if full else 0, self.config.replaced_most * n)
        return rows[np.argsort((prices - tolls)[rows], kind="stable")[: int(count)]]


def split(parents: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Split each of N Gaussians into two children, side by side on its longest axis."""
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
