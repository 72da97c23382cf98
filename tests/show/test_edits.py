"""Selection, deletion, cropping and undo of Gaussians."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.show.edits import HIGHLIGHT, HISTORY, Edits, Region


def grid(count: int = 4) -> Gaussians:
    """Gaussians at the whole numbers of a cube."""
    axis = np.arange(count, dtype=np.float32)
    means = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    n = len(means)
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    return Gaussians(
        means, np.zeros((n, 3), np.float32), quats, np.zeros(n, np.float32), np.ones((n, 4, 3), np.float32)
    )


CAMERA = Camera.look_at((1.5, 1.5, -20), (1.5, 1.5, 0), (0, -1, 0), 400, 200, 200)


def test_a_rectangle_selects_at_any_depth_and_adds_to_the_selection():
    edits = Edits(grid())
    edits.select_rectangle(CAMERA, (0.0, 0.0), (0.5, 0.5))
    rows = np.flatnonzero(edits.selected)
    chosen = edits._all.means[rows]
    assert len(rows) == 16 and (chosen[:, :2] < 1.5).all() and len({*chosen[:, 2]}) == 4
    edits.select_rectangle(CAMERA, (0.5, 0.5), (1.0, 1.0))
    assert edits.selected.sum() == 32
    edits.select_none()
    assert not edits.selected.any()


def test_nothing_behind_the_camera_is_selected():
    edits = Edits(grid())
    away = Camera.look_at((1.5, 1.5, -20), (1.5, 1.5, -40), (0, -1, 0), 400, 200, 200)
    edits.select_rectangle(away, (-9.0, -9.0), (9.0, 9.0))
    assert not edits.selected.any()


def test_isolated_gaussians_are_those_far_from_others():
    gaussians = grid(5)
    gaussians.means[[3, 70]] = [[40, 0, 0], [0, -35, 9]]
    edits = Edits(gaussians)
    edits.select_isolated()
    assert np.flatnonzero(edits.selected).tolist() == [3, 70]


def test_isolated_means_two_deviations_of_the_logarithms():
    """Of the mean distance to eight neighbours, by all pairs of points."""
    gaussians = grid(6)
    rng = np.random.default_rng(0)
    gaussians.means[:] = rng.normal(size=(216, 3)) * rng.lognormal(0, 1, (216, 1))
    points = gaussians.means.astype(np.float64)
    pairs = np.sort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)
    logs = np.log(pairs[:, 1:9].mean(axis=1))
    edits = Edits(gaussians)
    edits.select_isolated()
    assert 3 < edits.selected.sum() < 15
    np.testing.assert_array_equal(edits.selected, logs > logs.mean() + 2 * logs.std())


def test_eight_gaussians_have_too_few_neighbours_to_be_isolated():
    edits = Edits(grid())
    edits.region = Region("box", (0, 0, 0), (1, 1, 1))
    edits.select_isolated()
    assert len(edits) == 8 and not edits.selected.any()


def test_deletions_are_undone_in_their_order():
    edits = Edits(grid())
    states = []
    for k in range(3):
        states.append(edits.kept.copy())
        edits.selected[10 * k : 10 * k + 5] = True
        assert edits.delete() == 5 and edits.steps == k + 1 and not edits.selected.any()
    assert len(edits) == 64 - 15 == len(edits.result())
    for k in (2, 1, 0):
        edits.undo()
        np.testing.assert_array_equal(edits.kept, states[k])
        assert np.flatnonzero(edits.selected).tolist() == list(range(10 * k, 10 * k + 5)), (
            "what came back is selected"
        )
    edits.undo()
    assert len(edits) == 64 and edits.steps == 0
    edits.select_none()
    assert edits.delete() == edits.crop() == edits.steps == 0, "nothing was deleted, and nothing is undone"


def test_the_history_is_bounded():
    edits = Edits(grid(6))
    for k in range(HISTORY + 5):
        edits.selected[k] = True
        edits.delete()
    assert edits.steps == HISTORY


def test_all_cannot_be_deleted():
    edits = Edits(grid())
    edits.selected[:] = True
    with pytest.raises(InputError, match="expected at least one Gaussian to remain"):
        edits.delete()
    assert len(edits) == 64 and edits.steps == 0


def test_all_in_the_region_cannot_be_deleted():
    """Nothing would be left to show, and the viewer needs at least one Gaussian."""
    edits = Edits(grid())
    edits.region = Region("box", (0, 0, 0), (1, 2, 3))
    edits.select_rectangle(CAMERA, (-9.0, -9.0), (9.0, 9.0))
    with pytest.raises(InputError, match="to remain in the crop region, found none"):
        edits.delete()
    assert len(edits) == edits.selected.sum() == 24 and edits.steps == 0
    edits.region = None
    assert edits.delete() == 24 and len(edits) == 64 - 24


def test_what_a_region_hides_is_not_selected():
    """Otherwise a deletion would remove what nobody sees."""
    edits = Edits(grid())
    edits.select_rectangle(CAMERA, (-9.0, -9.0), (9.0, 9.0))
    edits.region = Region("box", (0, 0, 0), (0, 2, 3))
    assert edits.selected.sum() == 3 * 4
    edits.region = Region("box", (0, 0, 0), (1, 2, 3))
    assert edits.delete() == 3 * 4 and len(edits) == 3 * 4
    edits.region = Region("box", (0, 0, 0), (0, 0, 3))
    edits.region = None
    edits.undo()
    assert len(edits) == 64 and edits.selected.sum() == 3 * 4
    edits.delete()
    edits.region = Region("box", (3, 0, 0), (0, 9, 9))
    edits.undo()
    assert not edits.selected.any(), "what came back is outside the region"


@pytest.mark.parametrize(
    ("region", "count"),
    [(Region("box", (0, 0, 0), (1, 2, 3)), 2 * 3 * 4), (Region("sphere", (0, 0, 0), (1, 9, 9)), 4)],
)
def test_only_the_region_is_shown_saved_and_selected(region, count):
    edits = Edits(grid())
    edits.region = region
    assert len(edits) == len(edits.result()) == count
    edits.select_rectangle(CAMERA, (-9.0, -9.0), (9.0, 9.0))
    assert edits.selected.sum() == count
    edits.region = None
    assert len(edits) == 64, "without the region all is back"
    edits.region = region
    assert edits.crop() == 64 - count
    edits.region = None
    assert len(edits) == count
    edits.undo()
    assert len(edits) == 64


def test_an_empty_region_is_a_sentence():
    edits = Edits(grid())
    edits.region = Region("sphere", (50, 0, 0), (1, 1, 1))
    with pytest.raises(InputError, match="the region holds no Gaussian"):
        edits.result()


def test_selected_gaussians_are_orange_and_saved_ones_are_not():
    gaussians = grid()
    edits = Edits(gaussians)
    edits.selected[7] = True
    shown = edits.shown()
    np.testing.assert_allclose(0.5 + 0.28209479 * shown.sh[7, 0], HIGHLIGHT, rtol=1e-6)
    assert not shown.sh[7, 1:].any()
    rest = np.arange(64) != 7
    np.testing.assert_array_equal(shown.sh[rest], gaussians.sh[rest])
    np.testing.assert_array_equal(edits.result().sh, gaussians.sh)
    assert (gaussians.sh == 1).all(), "the scene that was given is not changed"
