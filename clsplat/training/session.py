"""A training session: iterations of algorithm 1 of Kerbl et al. 2023, which can be run up to a point and forked."""

import warnings
from collections.abc import Callable, Sequence
from copy import copy
from functools import cached_property, lru_cache
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.constants import ALPHA_MIN
from clsplat.dataset.outlines import Grid, in_free_space
from clsplat.gaussians import Gaussians, logit
from clsplat.randomness import stream
from clsplat.renderer import Renderer
from clsplat.scene import Scene, View
from clsplat.stages import Dropout
from clsplat.training.autosize.validation import split
from clsplat.training.camera_room import steepest_slope, viewpoints, with_room
from clsplat.training.coarse_to_fine import factor_at, shrunk
from clsplat.training.contributions import contributions
from clsplat.training.corrections import compare, example, learn_pose
from clsplat.training.densify import Contributions, Edit
from clsplat.training.memory import INTERSECTIONS, Footprint, Photos
from clsplat.training.moving import due, moving, still
from clsplat.training.optimizer import Optimizer, adam_settings
from clsplat.training.rows import without_harmonics
from clsplat.training.sky_start import BEYOND
from clsplat.training.state import State

if TYPE_CHECKING:
    from clsplat.device import Device


class Training:
    """A training that can be run up to an iteration, and forked.

    Parameters
    ----------
    scene : Scene
        With at least one photo to train on.
    config : TrainConfig
    device : Device
    state : State
        State from which the training continues.
    backdrop : Gaussians, optional
        Gaussians that are drawn in every image and do not train, such as the surroundings of a block.
    empty : sequence of Grid
        Space that is kept free of Gaussians, as from `clsplat.training.sky_start.empty_space`.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        device: "Device",
        state: State,
        backdrop: Gaussians | None = None,
        empty: Sequence[Grid] = (),
    ):
        self.scene, self.config, self.device, self.state, self.empty = scene, config, device, state, empty
        self.renderer = Renderer(device, config.render, BACKGROUNDS[config.data.background], backdrop)
        self.optimizer = Optimizer(self.renderer, config.optimizer)
        self.photos = Photos(device)
        self._views: list[View] = []
        self._views_of: tuple[int, bool] | None = None  # the divisor of their edges, and whether some are held back
        if state.filter and state.filter.pixels is not None:  # of a checkpoint
            state.filter.pixels = self.renderer.upload("pixel sizes", state.filter.pixels)

    @cached_property
    def need(self) -> Footprint:
        """Device memory that the training takes."""
        backdrop = self.renderer.backdrop
        return Footprint.of(self.scene, self.config, self.device, 0 if backdrop is None else len(backdrop))

    def with_room(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians on the host, those of them shrunk that reach a viewpoint, if the strategy leaves room."""
        return with_room(gaussians, *self._room) if self.state.strategy.leaves_room else gaussians

    @cached_property
    def _room(self) -> tuple[Any, float]:
        """Viewpoints and slope for `clsplat.training.camera_room`."""
        cameras = [view.camera for view in self.scene.train]
        return viewpoints(cameras), steepest_slope(cameras)

    def fork(self, state: State) -> "Training":
        """Make a training of the same scene that continues from another state."""
        result = copy(self)
        result.state = state
        return result

    def run_until(self, last: int, after: Callable[["Training", float], None]) -> None:
        """Run the iterations up to `last`, and call `after` with the training and the loss after each."""
        if self.state.iteration < last:
            self.state.move(self.optimizer.home)
        while self.state.iteration < last:
            after(self, self.advance())

    def advance(self) -> float:
        """Run one iteration, and the edit that is due after it. Returns the loss."""
        iteration = self.state.iteration + 1
        self._choose_views(iteration)
        intersections = self.state.intersections or INTERSECTIONS
        in_use = self.need.total(len(self.state.gaussians), intersections)
        self.photos.keep_within(self.device.memory_limit - in_use)
        self.refresh_filter()
        loss = step(self, self._view(iteration))
        if self.config.mask_moving and due(iteration, self.config.iterations, bool(self.state.moving)):
            self._look_for_motion()
        if self.state.strategy.due(iteration):
            self.densify(self._cap())
        if self.state.filter and self.state.filter.due(iteration):
            self._measure_filter()
        return loss

    def _view(self, iteration: int) -> View:
        """View of an iteration. If photos stream, those of the next iterations are read at the same time."""
        view = view_at(iteration, self._views, self.config.seed)
        for later in range(iteration, iteration + view.ahead + 1) if view.ahead else ():
            self.photos.prefetch(view_at(later, self._views, self.config.seed))
        return view

    def _choose_views(self, iteration: int) -> None:
        """Take the photos of an iteration: at their size then, without those that are held back."""
        search = self.state.search
        wanted = factor_at(iteration, self.config), bool(search and search.holds_back(iteration))
        if self._views_of != wanted:
            self._views_of = factor, holds_back = wanted
            views = split(self.scene.train)[0] if holds_back else self.scene.train
            views = still(views, self.state.moving)
            self._views, self.photos = [shrunk(view, factor) for view in views], Photos(self.device)

    def _look_for_motion(self) -> None:
        """Find what moves in the training photos, which trains no more."""
        state, renderer = self.state, self.renderer
        degree = state.sh_degree(state.iteration, self.config)
        views = self.scene.train
        if state.exposures and state.search:  # the exposures of the others are not known yet, or not well
            views = split(views)[0]
        state.moving = moving(renderer, state.shown(renderer), state.corrected(views), degree)
        self._views_of = None

    def refresh_filter(self) -> None:
        """Measure the pixel sizes of the 3D filter, if there is one and its rows have changed."""
        if self.state.filter and self.state.filter.pixels is None:
            self._choose_views(self.state.iteration + 1)
            self._measure_filter()

    def _measure_filter(self) -> None:
        assert self.state.filter
        self.state.filter.measure(self.renderer.stages, self.renderer.place(self.state.gaussians), self._views)

    def _cap(self) -> int:
        """Largest number of Gaussians after the next edit.

        It is the user's limit, or what fits the device, or what the search allows; with too few photos for a search
        (`clsplat.training.few_views` sets a limit for them, where it is used) the present number.
        """
        fitting = self.need.most_gaussians(self.device.memory_limit, self.state.intersections)
        cap, n = min(self.config.max_gaussians or fitting, fitting), len(self.state.gaussians)
        if self.config.size == "auto":
            return min(cap, self.state.search.most if self.state.search else n)
        if n >= fitting:
            warnings.warn(f"no more than {fitting} Gaussians fit the memory: growth stops", stacklevel=2)
        return cap

    def densify(self, cap: int) -> None:
        """Make the edit that is due after the last iteration.

        Not a part of `step`, whose arrays of the old size must be freed before those of the new one are allocated.
        """
        self.state.move(self.optimizer.home)
        edit = self._edit(cap)
        self.state.change_rows(self.state.rows.after(edit, self.optimizer))
        self.state.move(self.optimizer.home)

    def _edit(self, cap: int) -> Edit:
        """The strategy's edit. It leaves the strategy's statistics on the host."""
        state = self.state
        sh_degree = state.sh_degree(state.iteration, self.config)

        def survey(count: int, fraction: float) -> Contributions:
            count = max(count, ceil(fraction * len(self._views)))
            order = stream(self.config.seed, "surveyed views", state.iteration).permutation(len(self._views))
            chosen = state.corrected([self._views[i] for i in order[:count]])
            found = contributions(self.renderer, state.shown(self.renderer), chosen, sh_degree)
            return found._replace(photos=len(self.scene.train))

        state.rows = state.rows._replace(strategy=state.strategy.on(None))
        gaussians = without_harmonics(state.gaussians)
        edit = state.strategy.edit(state.iteration, gaussians, cap, survey)
        if edit.reset_opacities and state.filter:
            reset_shown(edit, gaussians, without_harmonics(state.shown(self.renderer)))
        edit = edit._replace(gaussians=self.with_room(edit.gaussians))
        kept = ~in_free_space(edit.gaussians.means, self.empty)
        if kept.all() or not kept.any():
            return edit
        state.strategy.keep(kept)
        return edit._replace(gaussians=edit.gaussians.take(kept), rows=edit.rows[kept], fresh=edit.fresh[kept])


def step(training: Training, view: View) -> float:
    """Take one step: render a view, compare it with its photo, differentiate, update. Returns the loss."""
    state, config, renderer, optimizer = training.state, training.config, training.renderer, training.optimizer
    iteration = state.iteration + 1
    progress = (iteration - 1) / max(config.iterations - 1, 1)
    sh_degree = state.sh_degree(iteration, config)
    dropout = None
    if config.dropout:
        dropout = Dropout(config.dropout * progress, config.seed, iteration, BEYOND * state.extent)
    seen = example(view, iteration, state, training.photos, config, renderer)

    gaussians = state.shown(renderer)
    options: dict[str, Any] = {"background": seen.background, "dropout": dropout}
    if seen.disparities is not None:
        options["depth"] = "inverse"
    run = renderer.forward(gaussians, seen.camera, sh_degree, **options)
    loss, v_image = compare(run.image, seen, progress, state, config, renderer)
    v_splats = renderer.backward_to_splats(run, v_image)

    strategy, size = state.strategy, (seen.camera.width, seen.camera.height)
    if strategy.watches(iteration):
        statistics = optimizer.bring(run.splats.extents), optimizer.bring(v_splats.means2d)
        strategy.observe(optimizer.stages, *statistics, *size)
    penalties = (*strategy.penalties(len(gaussians)), config.optim.erank_penalty / len(gaussians))
    factor = state.search.rates(iteration, config) if state.search else 1.0
    settings = adam_settings(iteration, progress, state.extent, config.optim, sh_degree, penalties, factor)
    v_camera = optimizer.step(
        state.gaussians, state.moments, state.filter, run, v_splats, settings, camera_grad=state.poses is not None
    )
    learn_pose(seen, v_camera, progress, state, config)
    strategy.perturb(optimizer.stages, state.gaussians, iteration, settings.rates["means"])
    state.intersections = max(state.intersections, run.bins.gauss_ids.shape[0] / run.drawn.depths.shape[0])
    state.iteration = iteration
    return float(loss)


def view_at(iteration: int, views: list[View], seed: int) -> View:
    """View of an iteration, counted from 1. Every epoch takes all views, in another random order."""
    epoch, position = divmod(iteration - 1, len(views))
    return views[_order(seed, epoch, len(views))[position]]


@lru_cache(2)  # epochs: views are read ahead
def _order(seed: int, epoch: int, count: int) -> NDArray[np.intp]:
    return stream(seed, "order of the views", epoch).permutation(count)


def reset_shown(edit: Edit, gaussians: Gaussians, shown: Gaussians) -> None:
    """Lower to the reset's value the opacities that are shown under the 3D filter, and not those that train.

    Otherwise the filter would lower them further, and a Gaussian that becomes invisible has no gradient.

    Parameters
    ----------
    edit : Edit
        A reset; its opacities are changed in place.
    gaussians, shown : Gaussians
        Before the edit: as they train, and under the filter.
    """
    before = gaussians.opacities[edit.rows]
    raised = edit.gaussians.opacities * before / np.maximum(shown.opacities[edit.rows], ALPHA_MIN)
    most = np.minimum(before, 1 - 1e-6)  # whose logit is finite
    edit.gaussians.logit_opacities[:] = logit(np.clip(raised, edit.gaussians.opacities, most))
