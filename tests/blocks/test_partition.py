"""The cut of a scene: every point is in one box, boxes hold alike many, margins surround the shared faces only."""

import numpy as np
import pytest

from clsplat.blocks.partition import MARGIN, Box, cut


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_each_point_is_in_one_box_and_boxes_are_alike(count: int) -> None:
    points = np.random.default_rng(0).normal(size=(1000, 3)) * [5, 1, 2]
    inside = np.array([box.contains(points) for box in cut(points, count)])
    assert inside.shape[0] == count
    assert (inside.sum(axis=0) == 1).all()
    # A cut at a quantile of up to 1000 points is off by up to one, at each of up to three levels.
    assert np.abs(inside.sum(axis=1) - 1000 / count).max() <= 3
    far = np.array([[1e9, -1e9, 1e9]])
    assert sum(int(box.contains(far)[0]) for box in cut(points, count)) == 1


def test_the_longest_axis_is_cut_and_single_points_do_not_count() -> None:
    points = np.random.default_rng(0).uniform(size=(1000, 3)) * [1, 3, 1]
    points[0] = [1e6, 0, 0]
    left, right = cut(points, 2)
    assert left.high == (np.inf, right.low[1], np.inf)
    assert 1.4 < left.high[1] < 1.6


@pytest.mark.parametrize("sides", [(9, 1, 1), (3, 3, 1)])
@pytest.mark.parametrize("count", [2, 4, 9, 32])
def test_the_other_cut_has_its_borders_in_the_boxes_of_the_usual_one(sides: tuple[int, ...], count: int) -> None:
    """What is near a border of one cut is mostly in the middle of a box of the other one."""
    points = np.random.default_rng(0).uniform(size=(20_000, 3)) * sides
    near = []
    for between in (False, True):
        boxes = cut(points, count, between=between)
        inside = np.array([box.contains(points) for box in boxes])
        assert (inside.sum(axis=0) == 1).all() and len(boxes) == count + between
        shares = [0.5, *[1] * (count - 1), 0.5] if between else [1] * count
        np.testing.assert_allclose(inside.sum(axis=1), 20_000 / count * np.array(shares), rtol=0.02)
        wide = np.array([box.widened(points, MARGIN).contains(points) for box in boxes])
        near.append(wide.sum(axis=0) > 1)
    # Up to a third, as if the borders were independent of each other. If the other cut, too, divided boxes at half of
    # their parts, it would be three quarters for 32 boxes.
    assert np.mean(near[0] & near[1]) < 0.4 * near[0].mean()


def test_boxes_cost_the_same() -> None:
    points = np.random.default_rng(0).uniform(size=(1000, 3)) * [4, 1, 1]
    costs = np.where(points[:, 0] < 1, 9.0, 1.0)
    sums = [costs[box.contains(points)].sum() for box in cut(points, 4, costs)]
    # A cut is off by a point at most, of a cost of 9, at each of two levels.
    assert np.abs(np.array(sums) - costs.sum() / 4).max() <= 18


def test_a_margin_surrounds_shared_faces() -> None:
    points = np.random.default_rng(0).uniform(size=(10_000, 3))
    points[:, 0] *= 2
    left, right = cut(points, 2)
    wide = left.widened(points, MARGIN)
    assert wide.low == (-np.inf,) * 3 and wide.high[1:] == (np.inf,) * 2
    # Nine tenths of the side of 1 lie between the quantiles.
    np.testing.assert_allclose(wide.high[0] - left.high[0], MARGIN * 0.9, rtol=0.02)
    both = wide.contains(points) & right.widened(points, MARGIN).contains(points)
    assert 0.08 < both.mean() < 0.1


def test_fewer_points_than_boxes() -> None:
    boxes = cut(np.zeros((1, 3)), 4)
    assert len(boxes) == 4
    assert sum(int(box.contains(np.zeros((1, 3)))[0]) for box in boxes) == 1
    assert sum(int(box.contains(np.ones((1, 3)))[0]) for box in cut(np.zeros((0, 3)), 3)) == 1
    assert Box((0, 0, 0), (1, 1, 1)).widened(np.zeros((0, 3)), 0.5) == Box((0, 0, 0), (1, 1, 1))
