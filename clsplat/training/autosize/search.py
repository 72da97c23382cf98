"""The search for the number of Gaussians: it drives a training from trial to trial."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from clsplat.renderer import fetch
from clsplat.scene import View
from clsplat.training.autosize.reduction import costliest_rows
from clsplat.training.autosize.rule import (
    Candidate,
    Decision,
    Search,
    SmallSide,
    Trial,
    candidate,
    first_pruning,
    halvings,
    most_grown,
    most_identifiable,
    next_phase,
    trial_bounds,
    validation_times,
)
from clsplat.training.autosize.validation import split, validate
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
        Called after each iteration of the training, and of the smaller side of a trial. While the latter runs, the
        training's state stays as it was before the trial: an interruption loses the trial alone.
    """
    bounds, times = trial_bounds(training.config), validation_times(training.config)
    for iteration in sorted(times.union(bounds)):
        search = training.state.search
        if search is None or search.settled:
            return
        if iteration <= training.state.iteration:  # before the checkpoint that a run was resumed from
            continue
        training.run_until(iteration - 1, after)
        if search.small_side:
            search = replace(search, validated=[*search.validated, _validate(training)])
        if iteration in bounds:
            training.state = _decide(training, search, iteration, after_fork)
        else:
            training.state = replace(training.state, search=search)


def _decide(training: Training, search: Search, iteration: int, after_fork: After) -> State:
    """End the current trial, decide the next phase, train the smaller side of its trial. Returns the new state."""
    training.state.move(None)  # one side of a trial at a time is on the device
    state, trials = replace(training.state), search.trials
    if search.small_side:
        larger = _candidate(training, iteration, search.validated)
        trials = [*trials, Trial(iteration < first_pruning(training.config), search.small_side.candidate, larger)]
        if trials[-1].takes_smaller:
            state = replace(state, rows=search.small_side.rows, filter=state.filter and SmoothingFilter())
    search = state.search = Search(len(state.gaussians), trials)
    here = training.fork(state)  # an interruption of what follows leaves the training as it is
    here.refresh_filter()
    most = most_identifiable(training.scene.train, training.config)
    phase = next_phase(search, iteration, training.config, most)
    if phase == "settle":
        search = replace(search, settled=iteration, degrees=_degrees(here, iteration))
        best = max(search.degrees, key=lambda c: c.worth).sh_degree
        here.state.rows = here.state.rows.with_degree(best)
    elif phase in ("try", "prune"):
        search = replace(search, small_side=_train_small_side(here, phase, iteration, after_fork))
    here.state.search = replace(search, most=most_grown(search, phase, training.config, most))
    return here.state


def _train_small_side(training: Training, phase: Decision, iteration: int, after: After) -> SmallSide:
    """Fork a training and train the fork to the end of the trial: with the same Gaussians, or with the costliest.

    The rows of the training are on the host.
    """
    state, config = training.state, training.config
    rows = np.arange(len(state.gaussians))
    if phase == "prune":
        left = 2 ** -halvings(state.search.trials if state.search else [])
        gaussians, views = fetch(state.shown(training.renderer)), state.corrected(training.scene.train)
        rows = costliest_rows(gaussians, left, views, training.renderer)
    side = training.fork(state.fork(state.rows.take(rows)))
    validated = []
    end = next(bound for bound in trial_bounds(config) if bound > iteration)
    for time in sorted(time for time in validation_times(config) if iteration < time <= end):
        side.run_until(time - 1, after)
        validated.append(_validate(side))
    return SmallSide(side.state.rows.on(None), _candidate(side, end, validated))


def _degrees(training: Training, iteration: int) -> list[Candidate]:
    """Candidates for the degree of the spherical harmonics, of those that are trained."""
    state, config, renderer = training.state, training.config, training.renderer
    gaussians, views = state.shown(renderer), _validation_views(training)
    return [
        candidate(iteration, len(gaussians), degree, [validate(gaussians, views, renderer, degree)], config)
        for degree in range(state.sh_degree(state.iteration, config) + 1)
    ]


def _validation_views(training: Training) -> list[View]:
    """Views with their validation blocks alone, corrected by what this training has learned about each photo."""
    return training.state.corrected(split(training.scene.train)[1])


def _validate(training: Training) -> list[float]:
    """PSNR of each validation view, dB."""
    state, renderer = training.state, training.renderer
    degree = state.sh_degree(state.iteration, training.config)
    return validate(state.shown(renderer), _validation_views(training), renderer, degree)


def _candidate(training: Training, iteration: int, validated: list[list[float]]) -> Candidate:
    state = training.state
    degree = state.sh_degree(state.iteration, training.config)
    return candidate(iteration, len(state.gaussians), degree, validated, training.config)
