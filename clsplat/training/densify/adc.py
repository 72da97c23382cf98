"""Adaptive density control: clone, split, prune, reset (Kerbl et al. 2023, section 5.2)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import TrainConfig
from clsplat.gaussians import Gaussians, logit
from clsplat.randomness import stream
from clsplat.reference.project import rotations
from clsplat.stages import Stages
from clsplat.training.densify.strategy import Edit, Strategy, Survey

Array = NDArray[Any]

CHILDREN = 2
"""Children of a Gaussian that is split."""

CHILD_SHRINK = 1.6
"""Divisor of the scales of the children of a split (original: 0.8 * 2)."""


class Adc(Strategy):
    """The paper's strategy, with a hard cap on the number of Gaussians and a floor under pruning.

    Statistics: `grad_sum`, the sum over iterations of the norm of the positional gradient in normalised device
    coordinates, and `seen`, the number of iterations in which the Gaussian was on screen.
    """

    def __init__(self, config: TrainConfig, extent: float, n: int) -> None:
        super().__init__(config, extent, n)
        self.config, self.seed, self.extent = config.adc, config.seed, extent
        self.start = config.shortened(config.adc.start)
        # On white, Gaussians in empty space turn white instead of transparent. A reset at the first round of
        # densification makes those that are not needed transparent, and they are pruned (original).
        self.white = config.data.background == "white"
        self.first_edit = -(-self.start // config.adc.every) * config.adc.every
        self.stop = round(config.adc.stop_fraction * config.iterations)
        self._clear(n)

    def _clear(self, n: int) -> None:
        self.statistics = {"grad_sum": np.zeros(n, np.float32), "seen": np.zeros(n, np.int32)}

    def watches(self, iteration: int) -> bool:
        """See `clsplat.training.densify.Strategy`."""
        return iteration < self.stop

    def observe(self, stages: Stages, extents: Any, v_means2d: Any, width: int, height: int) -> None:
        """See `clsplat.training.densify.Strategy`."""
        stages.observe(extents, v_means2d, width, height, **self.statistics)

    def _densifies(self, iteration: int) -> bool:
        return self.start <= iteration < self.stop and iteration % self.config.every == 0

    def _resets(self, iteration: int) -> bool:
        early = self.white and iteration == self.first_edit
        periodic = not self.config.opacity_decay and iteration % self.config.reset_every == 0
        return iteration < self.stop and (early or periodic)

    def due(self, iteration: int) -> bool:
        """See `clsplat.training.densify.Strategy`."""
        return self._densifies(iteration) or self._resets(iteration)

    def edit(self, iteration: int, gaussians: Gaussians, cap: int, survey: Survey) -> Edit:
        """See `clsplat.training.densify.Strategy`."""
        edit = Edit(gaussians, np.arange(len(gaussians)), np.zeros(len(gaussians), bool))
        if self._densifies(iteration):
            edit = self._prune(iteration, self._densify(iteration, gaussians, cap))
            self._clear(len(edit.rows))
            if self.config.opacity_decay:
                edit.gaussians.logit_opacities = logit(
                    np.maximum(edit.gaussians.opacities * (1 - self.config.opacity_decay), np.finfo(np.float32).tiny)
                )
        if self._resets(iteration):
            lowered = Gaussians(**edit.gaussians.arrays())
            lowered.logit_opacities = np.minimum(
                lowered.logit_opacities, logit(np.float32(self.config.reset_opacity))
            )
            edit = edit._replace(gaussians=lowered, reset_opacities=True)
        return edit

    def _densify(self, iteration: int, gaussians: Gaussians, cap: int) -> Edit:
        c, n = self.config, len(gaussians)
        grads = self.statistics["grad_sum"] / np.maximum(self.statistics["seen"], 1)
        chosen = np.flatnonzero(grads >= c.grad_threshold)
        # Each adds one Gaussian. Where the cap leaves no room for all, the largest gradients come first.
        room = max(0, cap - n)
        if len(chosen) > room:
            chosen = np.sort(chosen[np.argsort(-grads[chosen], kind="stable")[:room]])
        large = gaussians.scales[chosen].max(axis=1) > c.scale_threshold * self.extent
        cloned, split = chosen[~large], chosen[large]
        kept = np.setdiff1d(np.arange(n), split)

        parents = np.repeat(split, CHILDREN)
        children = gaussians.take(parents)
        noise = stream(self.seed, "positions of split Gaussians", iteration).standard_normal((len(parents), 3))
        quats = children.quats / np.linalg.norm(children.quats, axis=1, keepdims=True)
        children.means = children.means + np.einsum(
            "nij,nj->ni", rotations(quats), noise.astype(np.float32) * children.scales
        )
        children.log_scales = children.log_scales - np.float32(np.log(CHILD_SHRINK))
        rows = np.concatenate([kept, cloned, parents])
        result = Gaussians.concatenate([gaussians.take(kept), gaussians.take(cloned), children])
        return Edit(result, rows, np.arange(len(rows)) >= len(kept))

    def _prune(self, iteration: int, edit: Edit) -> Edit:
        c, gaussians = self.config, edit.gaussians
        doomed = gaussians.opacities < c.opacity_min
        if iteration > c.reset_every:
            doomed |= gaussians.scales.max(axis=1) > c.scale_max * self.extent
        if len(gaussians) - doomed.sum() < c.min_gaussians:
            doomed[np.argsort(-gaussians.logit_opacities, kind="stable")[: c.min_gaussians]] = False
        keep = np.flatnonzero(~doomed)
        return Edit(gaussians.take(keep), edit.rows[keep], edit.fresh[keep])
