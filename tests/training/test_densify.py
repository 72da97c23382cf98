"""Every strategy keeps rows, moments and statistics in step; ADC does what the paper says."""

from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import pytest

from clsplat import reference
from clsplat.config import AdcConfig, ErrorConfig, McmcConfig, TrainConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, logit
from clsplat.testing import synthetic_scene
from clsplat.training.autosize.rule import growth_bounds, validation_times
from clsplat.training.densify import STRATEGIES, Contributions, ErrorGuided, Mcmc, Strategy
from clsplat.training.densify.adc import CHILD_SHRINK, Adc
from clsplat.training.densify.schedule import Schedule
from clsplat.training.densify.strategy import MOST_GAUSSIANS

N = 200
CONFIG = TrainConfig(strategy="adc", size="fixed", iterations=2000, adc=AdcConfig(start=350))
SIZE = (64, 48)


def scene() -> Gaussians:
    gaussians = synthetic_scene(N, seed=5)[0].astype(np.float32)
    gaussians.log_scales[: N // 2] = np.log(0.001)
    gaussians.log_scales[N // 2 :] = np.log([0.5, 0.1, 0.05])
    gaussians.logit_opacities[:] = logit(np.float32(0.5))
    return gaussians


def survey(views: int, fraction: float) -> Contributions:
    """As of photos that see each Gaussian the better the later it stands."""
    assert views > 0
    return Contributions(np.arange(N) / 2.0, np.arange(N) ** 2 / 100.0, np.arange(N) - 9.0, np.zeros(N), np.ones(N))


def observed(
    config: TrainConfig = CONFIG, rows: slice = slice(0, N), strategy: str = "adc"
) -> tuple[Strategy, Gaussians]:
    """A strategy that has seen a gradient of twice the threshold on `rows` of the scene."""
    result = STRATEGIES[strategy](config, 1.0, N)
    v_means2d = np.zeros((N, 2), np.float32)
    v_means2d[rows, 0] = 2 * config.adc.grad_threshold / (SIZE[0] / 2)
    result.observe(reference, np.ones((N, 2)), v_means2d, *SIZE)
    return result, scene()


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("room", [0, 37])
@pytest.mark.parametrize(("iteration", "iterations"), [(100, 2000), (600, 2000), (900, 2000), (300, 7000)])
def test_edits_are_consistent_capped_and_repeatable(
    strategy: str, iteration: int, iterations: int, room: int
) -> None:
    cap = N + room
    config = replace(
        CONFIG, adc=replace(CONFIG.adc, reset_every=300), max_gaussians=cap, strategy=strategy, iterations=iterations
    )
    runs = []
    for _ in range(2):
        instance, gaussians = observed(config, strategy=strategy)
        before = gaussians.astype(np.float32)
        edit = instance.edit(iteration, gaussians, cap, survey)
        assert all((a == b).all() for a, b in zip(before.arrays().values(), gaussians.arrays().values(), strict=True))
        m = len(edit.gaussians.validate())
        assert 0 < m <= cap
        assert edit.rows.shape == edit.fresh.shape == (m,)
        assert all(len(s) == m for s in instance.statistics.values())
        assert all(np.isfinite(a).all() and a.dtype == np.float32 for a in edit.gaussians.arrays().values())
        runs.append(edit)
    assert all(
        (a == b).all()
        for a, b in zip(runs[0].gaussians.arrays().values(), runs[1].gaussians.arrays().values(), strict=True)
    )


def test_small_gaussians_are_cloned_and_large_ones_split() -> None:
    strategy, gaussians = observed(rows=slice(N // 2 - 1, N // 2 + 1))
    edit = strategy.edit(100, gaussians, MOST_GAUSSIANS, survey)
    assert len(edit.rows) == N + 2
    small, large = N // 2 - 1, N // 2
    clones = np.flatnonzero(edit.rows == small)
    assert len(clones) == 2
    assert (edit.gaussians.means[clones] == gaussians.means[small]).all()
    assert edit.fresh[clones].tolist() == [False, True]
    children = np.flatnonzero(edit.rows == large)
    assert len(children) == 2
    assert edit.fresh[children].all()
    np.testing.assert_allclose(
        edit.gaussians.scales[children], gaussians.scales[[large] * 2] / CHILD_SHRINK, rtol=1e-6
    )
    # Positions are drawn from the parent: different from it, and within 6 standard deviations of the largest axis.
    offsets = edit.gaussians.means[children] - gaussians.means[large]
    assert (np.abs(offsets) > 0).any(axis=1).all()
    assert np.abs(offsets).max() < 6 * 0.5


def test_splits_are_distributed_as_the_parent() -> None:
    gaussians = scene().take(np.full(4000, N - 1))
    gaussians.quats[:] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # a quarter turn about z: x goes to y
    strategy = Adc(CONFIG, 1.0, len(gaussians))
    strategy.observe(reference, np.ones((4000, 2)), np.full((4000, 2), 1.0), *SIZE)
    edit = strategy.edit(100, gaussians, MOST_GAUSSIANS, survey)
    spread = (edit.gaussians.means - gaussians.means[0]).std(axis=0)
    # 8000 draws: the standard deviation is known to 1/sqrt(16000) = 0.8 %, four of which are 3 %.
    np.testing.assert_allclose(spread, [0.1, 0.5, 0.05], rtol=0.03)


def test_transparent_gaussians_go_but_never_all() -> None:
    strategy, gaussians = observed(rows=slice(0, 0))
    gaussians.logit_opacities[:3] = logit(np.float32(0.004))
    edit = strategy.edit(100, gaussians, MOST_GAUSSIANS, survey)
    assert edit.rows.tolist() == list(range(3, N))
    strategy, gaussians = observed(rows=slice(0, 0))
    gaussians.logit_opacities[:] = logit(np.float32(0.001)) + np.linspace(0, 1, N, dtype=np.float32)
    edit = strategy.edit(100, gaussians, MOST_GAUSSIANS, survey)
    assert edit.rows.tolist() == list(range(N - CONFIG.adc.min_gaussians, N))


def test_huge_gaussians_go_only_after_a_reset() -> None:
    for iteration, remaining in ((100, N), (300, N), (400, N // 2)):
        config = replace(CONFIG, adc=replace(CONFIG.adc, reset_every=300))
        strategy, gaussians = observed(config, rows=slice(0, 0))
        edit = strategy.edit(iteration, gaussians, MOST_GAUSSIANS, survey)
        assert len(edit.rows) == remaining


def test_the_cap_takes_the_largest_gradients_first() -> None:
    strategy, gaussians = observed()
    strategy.statistics["grad_sum"][[7, 11]] *= 3
    edit = strategy.edit(100, gaussians, N + 2, survey)
    assert sorted(edit.rows[edit.fresh].tolist()) == [7, 11]


def test_a_gradient_at_the_threshold_counts() -> None:
    strategy, gaussians = observed(rows=slice(0, 0))
    strategy.statistics["grad_sum"][5] = np.float32(CONFIG.adc.grad_threshold)
    config = replace(CONFIG.adc, grad_threshold=float(np.float32(CONFIG.adc.grad_threshold)))
    strategy.config = config  # type: ignore[attr-defined]
    assert strategy.edit(100, gaussians, MOST_GAUSSIANS, survey).rows[-1] == 5


def test_reset_lowers_opacities_and_clears_their_moments() -> None:
    config = replace(CONFIG, adc=replace(CONFIG.adc, reset_every=150))
    strategy, gaussians = observed(config)
    edit = strategy.edit(150, gaussians, MOST_GAUSSIANS, survey)
    assert edit.reset_opacities
    np.testing.assert_allclose(edit.gaussians.opacities, config.adc.reset_opacity, rtol=1e-5)
    # Nothing else changed: 150 is no multiple of `every`.
    assert (edit.rows == np.arange(N)).all()


def test_opacities_decay_in_the_place_of_resets() -> None:
    config = replace(CONFIG, adc=replace(CONFIG.adc, reset_every=100, opacity_decay=0.1))
    strategy, gaussians = observed(config, rows=slice(0, 0))
    gaussians.logit_opacities[:16] = -200  # of opacity 0; the least number keeps them
    gaussians.logit_opacities[16:] = [-300] * (N - 16)
    edit = strategy.edit(100, gaussians, MOST_GAUSSIANS, survey)
    assert np.isfinite(edit.gaussians.logit_opacities).all()
    strategy, gaussians = observed(config, rows=slice(0, 0))
    edit = strategy.edit(100, gaussians, MOST_GAUSSIANS, survey)
    assert not edit.reset_opacities
    np.testing.assert_allclose(edit.gaussians.opacities, 0.45, rtol=1e-5)
    assert not strategy.due(150), "nothing resets between rounds"


@pytest.mark.parametrize("background", ["black", "white"])
def test_on_white_the_first_round_resets(background: str) -> None:
    config = replace(CONFIG, data=replace(CONFIG.data, background=background))
    for iteration, resets in ((100, background == "white"), (200, False)):
        strategy, gaussians = observed(config, rows=slice(0, 0))
        edit = strategy.edit(iteration, gaussians, MOST_GAUSSIANS, survey)
        assert edit.reset_opacities == resets
        assert (edit.gaussians.opacities.max() < 0.02) == resets
    later = replace(config, adc=replace(config.adc, start=525))  # 150 in a run of 2000, between two rounds
    strategy, gaussians = observed(later, rows=slice(0, 0))
    assert not strategy.due(150)
    assert strategy.edit(200, gaussians, MOST_GAUSSIANS, survey).reset_opacities == (background == "white")


def test_nothing_changes_outside_its_time() -> None:
    strategy, _ = observed()
    assert [strategy.watches(i) for i in (1, 999, 1000)] == [True, True, False]
    assert [strategy.due(i) for i in (50, 99, 100, 101, 900, 1000)] == [False, False, True, False, True, False]


def test_gradients_count_in_normalised_device_coordinates() -> None:
    strategy = Adc(CONFIG, 1.0, 2)
    strategy.observe(reference, np.array([[1.0, 2], [1, 1]]), np.array([[3.0, 0.0], [0.0, 4.0]]), 20, 10)
    assert strategy.statistics["grad_sum"].tolist() == [30, 20]
    assert strategy.statistics["seen"].tolist() == [1, 1]


def schedule_of(strategy: str, **changes: Any) -> Schedule:
    made = STRATEGIES[strategy](replace(CONFIG, strategy=strategy, **changes), 1.0, N)
    assert isinstance(made, Mcmc | ErrorGuided)
    return made.schedule


@pytest.mark.parametrize(("strategy", "settings"), [("mcmc", McmcConfig()), ("error", ErrorConfig())])
@pytest.mark.parametrize("iterations", [300, 700, 2000, 7000, 30_000])
@pytest.mark.parametrize("cap", [50, 1001, 4000, 1_000_000])
def test_growth_reaches_the_cap_in_time(
    strategy: str, settings: McmcConfig | ErrorConfig, iterations: int, cap: int
) -> None:
    n, sizes = min(1000, cap), []
    schedule = schedule_of(strategy, iterations=iterations, max_gaussians=cap)
    for iteration in filter(schedule.due, range(1, iterations + 1)):
        before, n = n, schedule.count_after(iteration, n, cap)
        assert n == cap or n >= round(before * (1 + settings.growth))
        sizes.append((iteration, n))
    assert max(size for _, size in sizes) == cap
    first = next(iteration for iteration, size in sizes if size == cap)
    assert first <= max(settings.full_fraction * iterations, sizes[0][0])
    if cap == 1_000_000:  # no earlier than needed, which would split Gaussians that have hardly trained
        assert first == max([sizes[0][0], *(i for i, _ in sizes if i <= schedule.full)])


def test_rounds_are_from_the_start_to_before_the_end() -> None:
    settings = McmcConfig(start=200, every=100, stop_fraction=0.5)
    schedule = schedule_of("mcmc", iterations=30_000, max_gaussians=5000, mcmc=settings)
    times = (100, 200, 250, 14_900, 15_000, 15_100)
    assert [schedule.due(i) for i in times] == [False, True, False, True, False, False]


def test_growth_takes_nothing_away() -> None:
    """Where less than there is fits the device."""
    schedule = schedule_of("mcmc", max_gaussians=5000)
    assert [schedule.count_after(200, 1000, cap) for cap in (900, 1010)] == [1000, 1010]


def test_the_search_grows_by_a_quarter_up_to_its_cap() -> None:
    schedule = schedule_of("mcmc", size="auto", max_gaussians=None, iterations=6000)
    assert [schedule.count_after(200, 1000, cap) for cap in (3000, 1050)] == [1250, 1050]


def test_the_search_grows_faster_where_its_cap_is_far_away() -> None:
    """A tenth of the points of three scenes ended with a quarter of the Gaussians, and 1 to 2 dB worse."""
    schedule = schedule_of("error", size="auto", max_gaussians=None, iterations=3000)
    assert [schedule.count_after(300, 1000, cap) for cap in (1100, 1500, 10_000)] == [1100, 1500, 2000]


@pytest.mark.parametrize(("size", "rounds"), [("auto", 23), ("fixed", 11)])
def test_the_search_has_as_many_rounds_in_short_runs(size: Literal["auto", "fixed"], rounds: int) -> None:
    """Of mcmc, whose rounds have an interval in iterations, since a round grows by at most a quarter."""

    def due(iterations: int) -> int:
        schedule = schedule_of("mcmc", size=size, iterations=iterations, max_gaussians=5000)
        return sum(map(schedule.due, range(1, iterations + 1)))

    assert (due(3000), due(1500)) == (23, rounds)


@pytest.mark.parametrize("size", ["auto", "fixed"])
@pytest.mark.parametrize(("iterations", "growth"), [(1000, 50), (3000, 150), (4337, 217), (4994, 249)])
def test_error_has_a_round_in_each_twentieth_of_growth_and_each_tenth_afterwards(
    size: Literal["auto", "fixed"], iterations: int, growth: int
) -> None:
    schedule = schedule_of("error", size=size, iterations=iterations, max_gaussians=5000)
    times = [i for i in range(1, iterations + 1) if schedule.due(i)]
    full = round(0.4 * iterations)
    assert {*times} >= {full - k * growth for k in range(5)}
    assert [i for i in times if i > full] == [*range(full + 2 * growth, round(0.8 * iterations), 2 * growth)]
    config = replace(CONFIG, strategy="error", size=size, iterations=iterations, max_gaussians=5000)
    strategy = STRATEGIES["error"](config, 1.0, N)
    assert all(map(strategy.due, times)), "training asks for each round"


@pytest.mark.parametrize("iterations", [700, 1005, 3000, 4337, 7650])
def test_growth_comes_first_in_a_window(iterations: int) -> None:
    """Each window has a round at its begin, and the Gaussians it adds train before they are validated."""
    config = replace(CONFIG, strategy="error", size="auto", iterations=iterations)
    schedule = schedule_of("error", size="auto", iterations=iterations)
    for begin, end in pairwise(growth_bounds(config)):
        first = next(i for i in range(begin, end) if schedule.due(i))
        assert first <= min(begin + 4, *(t for t in validation_times(config) if t > begin))


def test_in_short_runs_too_gaussians_are_shrunk_until_an_interval_before_the_end() -> None:
    strategy = STRATEGIES["error"](replace(CONFIG, strategy="error", size="auto", iterations=1500), 1.0, N)
    assert [strategy.due(iteration) for iteration in (1350, 1425, 1500)] == [True, True, False]


@pytest.mark.parametrize("strategy", ["mcmc", "error"])
def test_growth_needs_a_cap(strategy: str) -> None:
    with pytest.raises(InputError, match=f"--max-gaussians: expected with --strategy {strategy}"):
        STRATEGIES[strategy](replace(CONFIG, strategy=strategy), 1.0, N)
