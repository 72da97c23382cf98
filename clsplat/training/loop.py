"""Training as algorithm 1 of Kerbl et al. 2023: the loop over iterations, and the edits of densification."""

import warnings
from collections.abc import Callable, Container
from copy import copy
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.constants import ALPHA_MIN
from clsplat.errors import DeviceError, InputError, driver_errors
from clsplat.gaussians import Gaussians, logit
from clsplat.pruning.prices import without_invisible
from clsplat.randomness import stream
from clsplat.renderer import Renderer, fetch
from clsplat.scene import Scene, View
from clsplat.training.autosize.explanation import write_report
from clsplat.training.autosize.reduction import without_useless_bands
from clsplat.training.autosize.search import search_size
from clsplat.training.autosize.validation import split
from clsplat.training.checkpoint import CHECKPOINT, load_state, write_photos
from clsplat.training.coarse_to_fine import factor_at, shrunk
from clsplat.training.contributions import contributions
from clsplat.training.densify import STRATEGIES, Contributions, Edit
from clsplat.training.memory import INTERSECTIONS, Footprint, Photos
from clsplat.training.optimizer import Optimizer
from clsplat.training.preparation import open_device
from clsplat.training.recorder import LOG, Recorder, log_file
from clsplat.training.rows import Rows
from clsplat.training.state import State, initial_state
from clsplat.training.step import step, view_at

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
        The state to go on from.
    """

    def __init__(self, scene: Scene, config: TrainConfig, device: "Device", state: State):
        self.scene, self.config, self.device, self.state = scene, config, device, state
        self.renderer = Renderer(device, config.render, BACKGROUNDS[config.data.background])
        self.optimizer = Optimizer(self.renderer, config.optimizer)
        self.photos = Photos(device)
        self._views: list[View] = scene.train
        self._views_of = 1, False  # the divisor of their edges, and whether blocks of them validate
        if state.filter and state.filter.pixels is not None:  # of a checkpoint
            state.filter.pixels = self.renderer.upload("pixel sizes", state.filter.pixels)

    @cached_property
    def need(self) -> Footprint:
        """Device memory that the training takes."""
        return Footprint.of(self.scene, self.config, self.device)

    def fork(self, state: State) -> "Training":
        """A training of the same scene that goes on from another state."""
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
        loss = step(self, view_at(iteration, self._views, self.config.seed))
        if self.state.strategy.due(iteration):
            self.densify(self._cap())
        if self.state.filter and self.state.filter.due(iteration):
            self._measure_filter()
        return loss

    def _choose_views(self, iteration: int) -> None:
        """Take the photos of an iteration: at their size then, without blocks that validate."""
        wanted = factor_at(iteration, self.config), bool(self.state.search and self.state.search.validates(iteration))
        if self._views_of != wanted:
            factor, validates = self._views_of = wanted
            views = split(self.scene.train)[0] if validates else self.scene.train
            self._views, self.photos = [shrunk(view, factor) for view in views], Photos(self.device)

    def refresh_filter(self) -> None:
        """Measure the pixel sizes of the 3D filter, if there is one and its rows have changed."""
        if self.state.filter and self.state.filter.pixels is None:
            self._measure_filter()

    def _measure_filter(self) -> None:
        assert self.state.filter
        self.state.filter.measure(self.renderer.stages, self.renderer.place(self.state.gaussians), self._views)

    def _cap(self) -> int:
        """Largest number of Gaussians after the next edit.

        It is the user's limit, or what fits the device, or what the search allows; with too few photos for a search,
        the present number.
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
        self.state.change_rows(self._edited(cap))
        self.state.move(self.optimizer.home)

    def _edited(self, cap: int) -> Rows:
        state = self.state
        shown = fetch(state.shown(self.renderer)) if state.filter else None
        surveyed = shown or state.gaussians
        sh_degree = state.sh_degree(state.iteration, self.config)

        def survey(count: int) -> Contributions:
            order = stream(self.config.seed, "surveyed views", state.iteration).permutation(len(self._views))
            chosen = state.corrected([self._views[i] for i in order[:count]])
            found = contributions(self.renderer, surveyed, chosen, sh_degree)
            return found._replace(share=len(chosen) / len(self._views))

        state.move(None)
        edit = state.strategy.edit(state.iteration, state.gaussians, cap, survey)
        if edit.reset_opacities and shown:
            reset_shown(edit, state.gaussians, shown)
        return state.rows.after(edit)


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


def train(
    scene: Scene,
    config: TrainConfig,
    out: Path | str,
    device: "Device | None" = None,
    *,
    resume: bool = False,
    evaluate: Callable[[Gaussians], dict[str, float]] | None = None,
    evaluate_after: Container[int] | None = None,
    progress: Callable[[dict[str, Any]], None] = lambda record: None,
) -> Gaussians:
    """Train Gaussians on a scene's photos.

    Parameters
    ----------
    scene : Scene
    config : TrainConfig
        Both as `clsplat.training.preparation.prepare` returns them, to do what ``clsplat train`` does.
    out : Path or str
        Folder for checkpoint.npz, from which an interrupted run resumes, and log.jsonl, one JSON object per line;
        created if missing.
    device : Device, optional
        Default: the one that `config.device` and `config.memory_limit` describe.
    resume : bool
        Continue from the checkpoint in `out`, to the same bits as a run that was never interrupted.
    evaluate : callable, optional
        Called every `config.eval_every` iterations with the Gaussians, on the device; what it returns is logged. Its
        time does not count.
    evaluate_after : container of int, optional
        Iterations after which `evaluate` is called instead.
    progress : callable
        Called after every iteration with iteration, loss, num_gaussians and gaussians, which are the ones that train
        and must not be changed. Its time does not count. If it raises KeyboardInterrupt, a checkpoint is written
        before the run ends.

    Returns
    -------
    Gaussians
        In the scene's coordinates, on the host, without those that no pixel shows.

    Raises
    ------
    InputError
        If the scene has no photos to train on, the strategy is unknown, the price is negative, or the checkpoint is
        of another configuration.
    DeviceError
        If the device's memory, or its limit, is exceeded.
    ClsplatError
        If the loss stops being finite.

    Warns
    -----
    UserWarning
        If the Gaussians stop growing because more would not fit the device's memory.
    """
    check(scene, config)
    out, device = Path(out), device or open_device(config)
    state = load_state(out / CHECKPOINT, scene.extent, config) if resume else initial_state(scene, config)
    training = Training(scene, config, device, state)
    with log_file(out / LOG, state.iteration) as log:
        recorder = Recorder(training, out, log, progress, evaluate, evaluate_after)
        try:
            with driver_errors():
                if state.search:
                    search_size(training, recorder.after, recorder.after_fork)
                training.run_until(config.iterations, recorder.after)
        except DeviceError as error:
            raise DeviceError(
                f"iteration {training.state.iteration + 1}: {error}; the last checkpoint in {out}, if there is one, "
                "is intact: --resume continues from it, and a lower --memory-limit stops growth earlier"
            ) from error
    return finish(training, out)


def check(scene: Scene, config: TrainConfig) -> None:
    """Raise an InputError if the configuration cannot train the scene."""
    if config.strategy not in STRATEGIES:
        raise InputError(f"--strategy: expected one of {', '.join(STRATEGIES)}, found {config.strategy!r}")
    if not config.size_price >= 0:
        raise InputError(f"--size-price: expected 0 or more, found {config.size_price}")
    if not scene.train:
        raise InputError("scene: expected at least one photo to train on, found none; lower --test-every")


def finish(training: Training, out: Path) -> Gaussians:
    """Write the reports of a training that has ended, and return its scene."""
    state, scene = training.state, training.scene
    if state.exposures or state.poses:
        write_photos(out / "photos.json", state, scene)
    gaussians = fetch(state.shown(training.renderer))
    state.move(None)  # what follows needs the device's memory
    if state.search:
        write_report(out / "size.json", state.search, training.config)
        gaussians = without_useless_bands(gaussians, state.corrected(scene.train), training.renderer)
    return without_invisible(gaussians)
