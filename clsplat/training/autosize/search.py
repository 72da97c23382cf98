"""The search for the number of Gaussians: it drives a training from window to window."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from clsplat.config import TrainConfig
from clsplat.renderer import fetch
from clsplat.training.autosize.reduction import costliest_rows
from clsplat.training.autosize.rule import (
    HALVING,
    Candidate,
    Search,
    SmallSide,
    Trial,
    best_degree,
    candidate,
    first_pruning,
    growth_ends,
    most_grown,
    most_with_all,
    prunes,
    validation_times,
    window_bounds,
)
from clsplat.training.autosize.validation import split, validate
from clsplat.training.coarse_to_fine import factor_at
from clsplat.training.moving import still
from clsplat.training.session import Training
from clsplat.training.smoothing_filter import SmoothingFilter
from clsplat.training.state import State

After = Callable[[Training, float], None]
"""Called after each iteration with the training and the loss."""


def search_size(training: Training, after: After, after_fork: After) -> None:
    """Run a training until the number of its Gaussians is settled.

    Parameters
    ----------
    training : Training
        With a search in its state, which may be a resumed one.
    after, after_fork : callable
        Called after each iteration of the training, and of the pruned side of a trial. While the latter runs, the
        training's state stays as it was before the trial: an interruption loses the trial alone.
    """
    bounds, times = window_bounds(training.config), validation_times(training.config)
    for iteration in sorted(times.union(bounds)):
        search = training.state.search
        if search is None or search.settled:
            return
        if iteration <= training.state.iteration:  # before the checkpoint that a run was resumed from
            continue
        training.run_until(iteration - 1, after)
        if iteration in times and (search.grows or search.small_side):
            search = replace(search, validated=[*search.validated, _validate(training)])
        if iteration not in bounds:
            training.state = replace(training.state, search=search)
            continue
        if search.grows:
            training.state, search = _grown(training, search, iteration)
        if iteration >= first_pruning(training.config):
            training.state = _pruned(training, search, iteration, after_fork)


def _grown(training: Training, search: Search, iteration: int) -> tuple[State, Search]:
    """End a window of growth: compare with the last candidate that paid, and return to it where growth ends."""
    training.state.move(None)
    state = replace(training.state)
    search = _compared(training, search, iteration)
    if growth_ends(search, len(state.gaussians), iteration, training.config):
        if search.small_side:
            state = _continued(state, search.small_side)
        search = replace(search, grows=False, small_side=None)
    search = replace(search, most=len(state.gaussians), validated=[])
    state.search = replace(search, most=most_grown(search, training.config))
    return state, state.search


def _compared(training: Training, search: Search, iteration: int) -> Search:
    """The search after a comparison of the present Gaussians with the last candidate that paid.

    One that was trained on smaller photos is not compared: larger photos would decide, not more Gaussians. Neither is
    any where something moves: what is left out of the photos differs from window to window.
    """
    if not search.validated:  # the run is too short
        return search
    present, paid = _candidate(training, iteration, search.validated), search.small_side
    comparable = paid and not training.state.moving and _same_photos(paid.candidate, present, training.config)
    if paid and comparable and paid.candidate.n < present.n:
        trial = Trial(True, paid.candidate, present)
        search = replace(search, trials=[*search.trials, trial])
        if trial.takes_smaller:
            return search
    return replace(search, small_side=SmallSide(training.state.rows.take(np.arange(present.n)), present))


def _same_photos(first: Candidate, second: Candidate, config: TrainConfig) -> bool:
    """Whether two candidates were last trained on photos of the same size."""
    before, after = (factor_at(max(1, each.iteration - 1), config) for each in (first, second))
    return before == after


def _pruned(training: Training, search: Search, iteration: int, after_fork: After) -> State:
    """End a trial of pruning; begin another one, whose pruned side is trained first, or settle. Returns the new
    state."""
    training.state.move(None)  # one side of a trial at a time is on the device
    state = replace(training.state)
    if search.small_side:
        trial = Trial(False, search.small_side.candidate, _candidate(training, iteration, search.validated))
        if trial.takes_smaller:
            state = _continued(state, search.small_side)
        search = replace(search, trials=[*search.trials, trial], small_side=None, validated=[])
    search = state.search = replace(search, most=len(state.gaussians))
    here = training.fork(state)  # an interruption of what follows leaves the training as it is
    here.refresh_filter()
    held = split(training.scene.train)[1]
    if prunes(search, iteration, len(held), training.config):
        here.state.search = replace(search, small_side=_train_pruned(here, iteration, after_fork))
        return here.state
    degrees = _degrees(here, iteration)
    best = best_degree(degrees).sh_degree
    if best < len(degrees) - 1:
        here.state.rows = here.state.rows.with_degree(best)
    photos = len(training.scene.train)
    most = most_with_all(search, photos - len(held), photos, training.config)
    here.state.search = replace(search, most=most, settled=iteration, degrees=degrees)
    return here.state


def _continued(state: State, side: SmallSide) -> State:
    """The state with the rows of the smaller candidate."""
    return replace(state, rows=side.rows, filter=state.filter and SmoothingFilter())


def _train_pruned(training: Training, iteration: int, after: After) -> SmallSide:
    """Fork a training, prune the fork, and train it to the end of the trial. The rows of the training are on the
    host."""
    state, config = training.state, training.config
    gaussians = fetch(state.shown(training.renderer))
    views = state.corrected(still(training.scene.train, state.moving))
    rows = costliest_rows(gaussians, HALVING, views, training.renderer)
    side = training.fork(state.fork(state.rows.take(rows)))
    validated = []
    end = next(bound for bound in window_bounds(config) if bound > iteration)
    for time in sorted(time for time in validation_times(config) if iteration < time <= end):
        side.run_until(time - 1, after)
        validated.append(_validate(side))
    return SmallSide(side.state.rows.on(None), _candidate(side, end, validated))


def _degrees(training: Training, iteration: int) -> list[Candidate]:
    """Candidates for the degree of the spherical harmonics, of those that are trained."""
    degrees = range(_trained_degree(training) + 1)
    n, config = len(training.state.gaussians), training.config
    return [candidate(iteration, n, degree, [_validate(training, degree)], config) for degree in degrees]


def _validate(training: Training, sh_degree: int | None = None) -> list[float]:
    """Quality of each held-back photo, dB, with the trained degree of the spherical harmonics or another one."""
    state, renderer = training.state, training.renderer
    if sh_degree is None:
        sh_degree = _trained_degree(training)
    held = still(split(training.scene.train)[1], state.moving)
    training.refresh_filter()
    return validate(state.shown(renderer), held, renderer, sh_degree, fitted=state.exposures is not None)


def _trained_degree(training: Training) -> int:
    return training.state.sh_degree(max(1, training.state.iteration), training.config)


def _candidate(training: Training, iteration: int, validated: list[list[float]]) -> Candidate:
    gaussians = training.state.gaussians
    return candidate(iteration, len(gaussians), gaussians.sh_degree, validated, training.config)
