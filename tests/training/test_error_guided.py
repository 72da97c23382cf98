"""The strategy error: what a split keeps, who is split and who makes room."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.config import ErrorConfig, TrainConfig
from clsplat.gaussians import Gaussians, logit
from clsplat.reference.project import rotations
from clsplat.testing import synthetic_scene
from clsplat.training.densify import Contributions, Survey
from clsplat.training.densify.error_guided import HARM, MEMORY, PRICED_PHOTOS, SURVEYED, TOLL, ErrorGuided, split

N = 100
CONFIG = TrainConfig(size="fixed", iterations=2000, strategy="error", max_gaussians=N)


def scene() -> Gaussians:
    gaussians = synthetic_scene(N, seed=3)[0].astype(np.float32)
    gaussians.logit_opacities[:] = logit(np.float32(0.5))
    return gaussians


def seeing(
    weights: np.ndarray,
    errors: np.ndarray,
    prices: np.ndarray | None = None,
    photos: int = 1,
    differences: np.ndarray | None = None,
    pairs: np.ndarray | None = None,
) -> Survey:
    none = np.zeros(N)

    def survey(views: int, fraction: float) -> Contributions:
        assert (views, fraction) == (CONFIG.error.views, SURVEYED)
        rest = (none if array is None else array for array in (differences, pairs))
        return Contributions(weights, errors, weights if prices is None else prices, *rest, photos)

    return survey


def covariances(gaussians: Gaussians) -> np.ndarray:
    axes = rotations(gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True))
    return np.einsum("nij,nj,nkj->nik", axes, gaussians.scales**2, axes)


def test_a_split_keeps_the_moments() -> None:
    """Opacity integrated over space, centre and covariance of the two together."""
    parents = scene().astype(np.float64)
    first, second = split(parents)

    def mass(gaussians: Gaussians) -> np.ndarray:
        return gaussians.opacities * gaussians.scales.prod(axis=1)

    np.testing.assert_allclose(mass(first) + mass(second), mass(parents), rtol=1e-9)
    np.testing.assert_allclose((first.means + second.means) / 2, parents.means, atol=1e-12)
    offset = (first.means - second.means) / 2
    spread = covariances(first) + offset[:, :, None] * offset[:, None, :]
    np.testing.assert_allclose(spread, covariances(parents), atol=1e-12)
    # Along the longest axis: the children are apart by more than they are wide, and the other axes stay.
    assert (np.linalg.norm(offset, axis=1) > first.scales.max(axis=1) * 0.8).all()
    assert (np.sort(first.scales)[:, :2].max(axis=1) <= parents.scales.max(axis=1)).all()
    np.testing.assert_array_equal(first.sh, parents.sh)


def test_opaque_parents_have_finite_children() -> None:
    parents = scene()
    parents.logit_opacities[:] = 40
    for child in split(parents):
        assert all(np.isfinite(a).all() and a.dtype == np.float32 for a in child.arrays().values())


def test_the_largest_errors_are_split() -> None:
    rng = np.random.default_rng(0)
    errors = rng.permutation(N).astype(float)
    strategy = ErrorGuided(CONFIG, 1.0, N)
    edit = strategy.edit(200, scene(), 1000, seeing(np.ones(N), errors))
    target = strategy.schedule.count_after(200, N, 1000)
    assert N < len(edit.rows) == target < 1000
    parents = np.unique(edit.rows[edit.fresh])
    assert sorted(parents) == sorted(np.argsort(-errors)[: target - N])
    assert (np.bincount(edit.rows[edit.fresh], minlength=N)[parents] == 2).all()
    kept = edit.rows[~edit.fresh]
    np.testing.assert_array_equal(edit.gaussians.means[~edit.fresh], scene().means[kept])


@pytest.mark.parametrize(("harmful", "gone"), [(0, 5), (3, 5), (8, 8), (40, 20)])
def test_at_the_cap_those_of_least_price_make_room(harmful: int, gone: int) -> None:
    """5 % at least, all that do harm up to 20 %; transparent ones too; what the survey did not see stays."""
    order = np.random.default_rng(0).permutation(N)
    prices = np.empty(N)
    prices[order] = np.arange(N) + 0.5 - harmful
    weights, errors = np.ones(N), prices + 100
    weights[order[50]] = prices[order[50]] = errors[order[50]] = 0
    gaussians = scene()
    gaussians.logit_opacities[order[70]] = logit(0.004)
    faint = float(gaussians.opacities[order[70]])  # as much as the least opacity
    error = ErrorConfig(replaced=0.05, replaced_most=0.2, opacity_min=faint)
    strategy = ErrorGuided(replace(CONFIG, error=error), 1.0, N)
    edit = strategy.edit(600, gaussians, N, seeing(weights, errors, prices))
    assert len(edit.rows) == N
    assert np.setdiff1d(np.arange(N), edit.rows).tolist() == sorted([*order[:gone], order[70]])
    split_most = [i for i in order[::-1] if i != order[70]][: gone + 1]
    assert np.unique(edit.rows[edit.fresh]).tolist() == sorted(split_most)


def test_while_there_is_room_only_real_harm_goes() -> None:
    """Not what would lower the error a little by going, and no more than 5 % at once."""
    share = 2.0
    prices, errors = np.full(N, 1.0), np.full(N, share)
    prices[:5] = -HARM * share * np.array([0.9, 0.5, 0.1, 1.1, 3])
    strategy = ErrorGuided(CONFIG, 1.0, N)
    gone = np.setdiff1d(np.arange(N), strategy.edit(200, scene(), 2 * N, seeing(np.ones(N), errors, prices)).rows)
    assert gone.tolist() == [3, 4]
    prices[:] = -share
    strategy = ErrorGuided(CONFIG, 1.0, N)
    edit = strategy.edit(200, scene(), 2 * N, seeing(np.ones(N), errors, prices))
    assert len(np.setdiff1d(np.arange(N), edit.rows)) == CONFIG.error.replaced_most * N


@pytest.mark.parametrize("harmful", [0, 3])
def test_those_go_that_explain_least_for_their_pairs(harmful: int) -> None:
    """As many as without tolls, but those of the lowest prices less an even share of the error per pair."""
    rng = np.random.default_rng(0)
    pairs, errors, prices = rng.uniform(1, 100, N), rng.uniform(1, 3, N), rng.uniform(1, 3, N)
    prices[:harmful] = -0.1
    edit = ErrorGuided(CONFIG, 1.0, N).edit(200, scene(), N, seeing(np.ones(N), errors, prices, pairs=pairs))
    left = prices - TOLL * errors.sum() / pairs.sum() * pairs
    count = max(harmful, round(CONFIG.error.replaced * N))
    assert np.setdiff1d(np.arange(N), edit.rows).tolist() == sorted(np.argsort(left)[:count])


def test_removals_are_priced_together() -> None:
    """Each of 20 equal Gaussians in one place is too bright for the photo by 2 of them: alone it would gain by going,
    but with the others it would leave a hole. One elsewhere that is entirely wrong goes."""
    difference, excess = 1.0, 2
    prices, differences = np.full(N, 1.0), np.zeros(N)
    prices[:20], differences[:20] = difference * (1 - 2 * excess), difference
    prices[50], differences[50] = -100 * difference, difference
    for cap in (N, 2 * N):
        config = replace(CONFIG, error=ErrorConfig(replaced=0.0, replaced_most=0.2))
        strategy = ErrorGuided(config, 1.0, N)
        edit = strategy.edit(200, scene(), cap, seeing(np.ones(N), np.ones(N), prices, differences=differences))
        assert np.setdiff1d(np.arange(N), edit.rows).tolist() == [50]


def test_what_earlier_surveys_showed_stays() -> None:
    """Two Gaussians seem useless in the second survey, but the first showed the use of one of them."""
    strategy = ErrorGuided(replace(CONFIG, error=ErrorConfig(replaced=0.0)), 1.0, N)
    useful, prices = np.zeros(N), np.ones(N)
    useful[7] = 1
    strategy.edit(200, scene(), N, seeing(np.ones(N), np.zeros(N), prices, differences=useful))
    prices[[7, 8]] = -1
    edit = strategy.edit(300, scene(), N, seeing(np.ones(N), np.zeros(N), prices))
    assert np.setdiff1d(np.arange(N), edit.rows).tolist() == [8]
    assert strategy.statistics["differences"][7] == pytest.approx(MEMORY)


def test_children_inherit_a_quarter_of_the_squared_effect() -> None:
    strategy = ErrorGuided(CONFIG, 1.0, N)
    differences = np.arange(N, dtype=np.float64)
    edit = strategy.edit(200, scene(), 2 * N, seeing(np.ones(N), np.ones(N), differences=differences))
    assert edit.fresh.any() and not edit.fresh.all()
    expected = np.where(edit.fresh, 0.25, 1) * edit.rows
    np.testing.assert_array_equal(strategy.statistics["differences"], expected.astype(np.float32))


@pytest.mark.parametrize(("photos", "gone"), [(PRICED_PHOTOS, 5), (PRICED_PHOTOS + 1, 0)])
def test_none_makes_room_where_there_are_many_photos(photos: int, gone: int) -> None:
    """Neither the least useful nor those that do harm in it: the other photos may need them."""
    for cap in (N, 2 * N):
        strategy = ErrorGuided(CONFIG, 1.0, N)
        prices = np.full(N, 1.0)
        prices[:5] = -2 * HARM
        edit = strategy.edit(200, scene(), cap, seeing(np.ones(N), np.ones(N), prices, photos))
        assert len(np.setdiff1d(np.arange(N), edit.rows)) == gone


def test_what_has_no_error_is_not_split() -> None:
    errors = np.zeros(N)
    errors[:3] = 1
    strategy = ErrorGuided(CONFIG, 1.0, N)
    edit = strategy.edit(1400, scene(), 2 * N, seeing(np.zeros(N), errors))
    assert len(edit.rows) == N + 3


@pytest.mark.parametrize("logit_opacity", [-20.0])
def test_nothing_lives(logit_opacity: float) -> None:
    gaussians = scene()
    gaussians.logit_opacities[:] = logit_opacity
    edit = ErrorGuided(CONFIG, 1.0, N).edit(600, gaussians, N, seeing(np.ones(N), np.ones(N)))
    assert (edit.rows == np.arange(N)).all()
