"""The search for the size of a scene within a training: the trials of `clsplat.training.autosize.rule`."""

from collections.abc import Callable
from copy import copy, deepcopy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from clsplat.config import TrainConfig
from clsplat.render import fetch
from clsplat.scene import View
from clsplat.training.autosize import rule as size
from clsplat.training.checkpoint import State, as_seen, filtered, measure_pixels, move
from clsplat.training.optimizer import sh_degree_at

if TYPE_CHECKING:
    from clsplat.device import Device


def seek_size(
    state: State,
    iteration: int,
    views: list[View],
    config: TrainConfig,
    device: "Device",
    go: Callable[[State, int], float],
    tell: Callable[[State, float], None],
) -> State:
    """What `clsplat.training.autosize.rule` does before an iteration: end a trial, begin the next, choose.

    The state that is given stays whole until another is returned: whoever interrupts a trial loses that alone.
    """
    before = state.search
    if before is None or before.settled:
        return state
    stops, looks = size.stops(config), size.looks(config)
    if iteration not in (looks if before.rival else stops):
        return state
    training, validation = (as_seen(part, state) for part in size.split(views))

    def degree(state: State) -> int:
        every = config.shortened(config.optim.sh_degree_every)
        return sh_degree_at(state.iteration, every, state.gaussians.sh_degree)

    def look(state: State) -> list[float]:
        return size.validate(fetch(filtered(state, device)), validation, config, device, degree(state))

    def point(at: int, state: State, seen: list[list[float]]) -> size.Point:
        return size.point(at, len(state.gaussians), degree(state), seen, config)

    seen = [*before.seen, look(state)] if before.rival else []
    if iteration not in stops:
        return replace(state, search=replace(before, seen=seen))
    move(state, None)
    search = replace(before, trials=[*before.trials], rival=None, seen=[])
    state = replace(state, search=search, strategy=copy(state.strategy))
    if before.rival:
        grown = iteration < size.first_shrink(config)
        search.trials.append(size.Trial(grown, before.rival.point, point(iteration, state, seen)))
        if search.trials[-1].takes_smaller:
            state.gaussians, state.moments, state.strategy.statistics = before.rival.kept
            state.pixels = None  # of other rows
    if config.filter_3d and state.pixels is None:
        measure_pixels(state, training, device)
    search.most = len(state.gaussians)
    most = size.most_identifiable(views, config)
    todo = size.next_trial(search, iteration, config, most)
    if todo == "settle":
        here = size.Kept(state.gaussians, state.moments, state.strategy.statistics)
        shown = fetch(filtered(state, device))
        chosen = size.settle(search, iteration, shown, validation, config, device, degree(state))
        state.gaussians, state.moments, state.strategy.statistics = size.lower_degree(here, chosen)
    elif todo in ("try", "shrink"):
        end = stops[stops.index(iteration) + 1]
        trial = smaller_side(state, as_seen(views, state) if todo == "shrink" else None, config, device)
        seen = []
        for i in range(iteration, end):
            tell(trial, go(trial, i))
            if i + 1 in looks:
                seen.append(look(trial))
        move(trial, None)
        kept = size.Kept(trial.gaussians, trial.moments, trial.strategy.statistics)
        search.rival = size.Rival(kept, point(end, trial, seen))
    search.most = size.most_grown(search, todo, config, most)
    if config.optimizer == "device":
        move(state, device)
    return state


def smaller_side(state: State, views: list[View] | None, config: TrainConfig, device: "Device") -> State:
    """A state that shares nothing with this one and has its Gaussians or, given views, those that they would miss
    most."""
    rows = np.arange(len(state.gaussians))
    if views and state.search:
        left = 2 ** -size.halvings(state.search.trials)
        rows = size.costliest_rows(fetch(filtered(state, device)), left, views, config, device)
    here = size.Kept(state.gaussians, state.moments, state.strategy.statistics)
    gaussians, moments, statistics = here.take(rows)
    strategy, search = copy(state.strategy), state.search and replace(state.search, most=len(rows))
    strategy.statistics = statistics
    learned = {name: deepcopy(getattr(state, name)) for name in ("exposures", "poses")}
    trial = replace(
        state, gaussians=gaussians, moments=moments, strategy=strategy, search=search, pixels=None, **learned
    )
    if config.optimizer == "device":
        move(trial, device)
    return trial
