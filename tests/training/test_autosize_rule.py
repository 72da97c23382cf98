"""The rule of the size in numbers: what a change must earn, when growth and pruning end, how far growth goes."""

import json
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from clsplat.config import TrainConfig
from clsplat.training.autosize.rule import (
    TRIAL_RATES,
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
    sh_bytes,
    validation_times,
    window_bounds,
)
from clsplat.training.optimizer import sh_degree_at

CONFIG = TrainConfig(iterations=3000)


def trial(grows: bool, gains: list[float], price: float = 0.1) -> Trial:
    """A comparison of 100 and 200 Gaussians by the gains of the larger side in each photo."""
    config = replace(CONFIG, size_price=price)
    views = np.linspace(25, 30, len(gains))
    smaller, larger = views.tolist(), (views + gains).tolist()
    return Trial(grows, candidate(1, 100, 3, [smaller], config), candidate(1, 200, 3, [larger], config))


def test_a_change_is_earned_beyond_chance() -> None:
    """The larger side must gain more than its price by the standard error, whether it has grown or was not pruned. It
    loses if it gains less by as much."""
    found = trial(True, [0.1, 0.3])
    assert (found.gain, found.margin, found.price) == pytest.approx((0.2, 0.1, 0.1))
    assert trial(True, [-9.0, 0.1, 0.3, 0.4]).margin == pytest.approx(1.4826 * 0.15 / 2), (
        "one photo is far from all others"
    )
    for grows in (True, False):
        assert not trial(grows, [0.11, 0.4]).takes_smaller and trial(grows, [0.09, 0.4]).takes_smaller
        assert trial(grows, [0.09, 0.09]).takes_smaller and not trial(grows, [0.11, 0.11]).takes_smaller
        assert not trial(grows, [-3.7, 0.72, 0.74, 0.87]).takes_smaller, "one photo does not decide"
    assert trial(True, [-0.3, 0.09]).larger_loses and not trial(True, [-0.3, 0.11]).larger_loses


def side(n: int, quality: float = 30.0) -> SmallSide:
    return SmallSide(None, candidate(1, n, 3, [[quality, quality]], CONFIG))  # type: ignore[arg-type]


def test_growth_ends_where_it_has_not_paid_for_a_doubling() -> None:
    search = Search(1000, 1.5, small_side=side(500))
    assert not growth_ends(search, 999, 900, CONFIG) and growth_ends(search, 1000, 900, CONFIG)
    assert growth_ends(search, 600, 1500, CONFIG), "its time is over"
    assert growth_ends(search, 600, 900, replace(CONFIG, max_gaussians=600)), "the user's limit is reached"


def test_photos_are_held_back_in_the_iteration_that_settles() -> None:
    search = Search(1000, settled=5)
    assert [search.holds_back(iteration) for iteration in (4, 5, 6)] == [True, True, False]
    assert Search(1000).holds_back(6)


def test_learning_rates_are_low_in_trials_of_pruning() -> None:
    search, first = Search(1000), first_pruning(CONFIG)
    assert [search.rates(i, CONFIG) for i in (first - 1, first, 1600)] == [1, TRIAL_RATES, TRIAL_RATES]
    assert replace(search, settled=1500).rates(1500, CONFIG) == 1


def test_pruning_is_tried_until_it_fails() -> None:
    """By at least four held-back photos, and where growth lost."""
    failed, went = trial(False, [1.0, 1.0]), trial(False, [-1.0, -1.0])
    lost, paid, unclear = trial(True, [-0.1, 0.0]), trial(True, [1.0, 1.0]), trial(True, [-1.0, 1.0])
    search, first = Search(500, grows=False, trials=[paid, lost]), first_pruning(CONFIG)
    assert prunes(search, first, 4, CONFIG) and not prunes(search, first, 3, CONFIG)
    for trials, tries in (([lost, went], True), ([lost, went, failed], False), ([], False)):
        assert prunes(replace(search, trials=trials), first, 4, CONFIG) == tries
    for last in (paid, unclear):
        assert not prunes(replace(search, trials=[lost, last]), first, 4, CONFIG)
    assert not prunes(search, window_bounds(CONFIG)[-1], 4, CONFIG), "time is over"


def test_worth_counts_doublings_of_bytes() -> None:
    config = replace(CONFIG, size_price=0.25)
    one, two = (candidate(1, n, 3, [[30.0]], config) for n in (100, 200))
    assert one.worth - two.worth == pytest.approx(0.25)
    plain, rich = (candidate(1, 100, degree, [[30.0]], config) for degree in (0, 3))
    assert plain.worth - rich.worth == pytest.approx(0.25 * np.log2(sh_bytes(3) / sh_bytes(0)))


def test_the_degree_is_lowered_where_the_highest_one_loses() -> None:
    """Beyond chance: of degrees that cannot be told apart the highest one stays, even with the lowest worth."""

    def chosen(*views: list[float]) -> int:
        return best_degree([candidate(1, 100, degree, [v], CONFIG) for degree, v in enumerate(views)]).sh_degree

    same, better, unclear = [30.0, 30.0], [31.0, 31.0], [29.7, 30.2]
    assert chosen(same, same) == 0
    assert chosen(same, better) == 1
    assert chosen(same, unclear) == 1
    assert chosen(same, better, same) == 1
    assert chosen(better, same, unclear) == 0


def test_windows_are_within_the_run() -> None:
    assert window_bounds(CONFIG) == [300, 600, 900, 1200, 1350, 1500, 1650]
    assert sorted(validation_times(CONFIG))[:3] == [200, 250, 300]
    for iterations in (1, 2, 3, 10, 19):
        found = window_bounds(replace(CONFIG, iterations=iterations))
        assert found and 1 <= found[0] and found[-1] <= iterations


@pytest.mark.parametrize("iterations", [100, 1000, 3000, 4337, 7650, 30_000])
def test_each_degree_is_trained_before_one_is_chosen(iterations: int) -> None:
    """The last band for a quarter of the iterations until then."""
    config = replace(CONFIG, iterations=iterations)
    chosen = first_pruning(config)
    assert sh_degree_at(3 * chosen // 4 + 2, config.shortened(config.optim.sh_degree_every), 3) == 3


def test_photos_that_return_bring_gaussians_where_growth_paid() -> None:
    """In proportion to the photos, unless the last growth was not taken; where nothing was compared, it was."""
    paid, unpaid, halved = trial(True, [1.0, 1.0]), trial(True, [0.0, 0.0]), trial(False, [-1.0, -1.0])
    unclear = trial(True, [-1.0, 1.0])

    def most(*trials: Trial, config: TrainConfig = CONFIG) -> int:
        return most_with_all(Search(1000, grows=False, trials=list(trials)), 22, 26, config)

    assert most(paid) == most(unpaid, paid) == most() == 1182
    assert most(paid, unpaid) == most(unpaid, halved) == most(unclear) == 1000
    assert most(paid, config=replace(CONFIG, max_gaussians=1100)) == 1100


def test_growth_keeps_to_its_pace_until_it_ends() -> None:
    search = Search(1001, 1.5)
    assert most_grown(search, CONFIG) == 1502 and most_grown(replace(search, grows=False), CONFIG) == 1001
    assert most_grown(search, replace(CONFIG, max_gaussians=1200)) == 1200


SAVED = {"trials": [trial(True, [0.1, 0.3])], "degrees": [], "validated": [[30.0, 31.0]]}


@pytest.mark.parametrize(
    "damage",
    [
        {"most": 0},
        {"most": 1.5},
        {"pace": 0.0},
        {"grows": 1},
        {"settled": -1},
        {"validated": [[30.0]]},  # of one photo, and the trials are of two
        {"trials": [[1, *trial(True, [0.1, 0.3])[1:]]]},
        {"degrees": [side(500).candidate._replace(n=-1)]},
    ],
)
def test_a_search_is_restored_unless_it_is_damaged(damage: dict[str, Any]) -> None:
    search = Search(1000, 1.5, settled=5, **SAVED)  # type: ignore[arg-type]
    saved = json.loads(json.dumps(asdict(search)))
    assert Search.restored(saved, None) == search
    with pytest.raises((TypeError, ValueError)):
        Search.restored(saved | json.loads(json.dumps(damage)), None)
