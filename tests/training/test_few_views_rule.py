"""The configuration for few photos: whether the size is searched, the largest number of Gaussians, and dropout."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_run_length import with_photos

from clsplat.config import FewViewsConfig, InitConfig, TrainConfig
from clsplat.scene import Scene
from clsplat.training.autosize.rule import RANDOM_START
from clsplat.training.few_views import adapted

SMALL = (40, 30)  # 1200 pixels


def scene_of(photos: int, size: tuple[int, int] = SMALL, points: int = 1000) -> Scene:
    scene = with_photos(*size, 1)
    return Scene(scene.train * photos, [], np.zeros((points, 3)), np.zeros((points, 3)))


@pytest.mark.parametrize(
    ("photos", "size", "points", "most", "dropout"),
    [
        (23, SMALL, 1000, 3000, 0.1),  # what a search may reach: three times the points
        (17, SMALL, 1000, 3000, 0.1),
        (17, (100, 70), 1000, 7000, 0.1),  # or one per pixel
        (16, SMALL, 1000, 4000, 0.2),  # half of eight times the points, or one per pixel
        (16, (100, 70), 1000, 7000, 0.2),
        (16, (300, 300), 1000, 8000, 0.2),  # at most eight times the points
        (16, (600, 600), 1000, 127_279, 0.2),  # large photos: what a search may reach, 90 000 times the root of 2
        (16, (600, 600), 40_000, 320_000, 0.2),  # if this is more
    ],
)
def test_numbers_by_hand(photos: int, size: tuple[int, int], points: int, most: int, dropout: float) -> None:
    scene = scene_of(photos, size, points)
    config = adapted(TrainConfig(), scene)
    assert config == replace(TrainConfig(), size="fixed", max_gaussians=most, dropout=dropout)


@pytest.mark.parametrize(
    ("photos", "size", "points"), [(16, (20, 20), 1000), (16, (600, 600), 1000), (20, (20, 20), 9)]
)
def test_a_low_price_raises_the_number(photos: int, size: tuple[int, int], points: int) -> None:
    scene = scene_of(photos, size, points)
    found, half = (adapted(TrainConfig(size_price=price), scene).max_gaussians for price in (0.05, 0.025))
    assert half == pytest.approx(2 * found, abs=1)


def test_below_may_be_more_than_a_search_needs() -> None:
    found = adapted(TrainConfig(few=FewViewsConfig(below=50)), scene_of(40))
    assert (found.size, found.max_gaussians, found.dropout) == ("fixed", 4000, 0.2)


@pytest.mark.parametrize(("photos", "dropout"), [(23, 0.1), (24, 0.0), (100, 0.0)])
def test_with_refined_poses_the_size_is_not_searched(photos: int, dropout: float) -> None:
    found = adapted(TrainConfig(poses=True), scene_of(photos))
    assert (found.size, found.max_gaussians, found.dropout) == ("fixed", 3000, dropout)
    fixed = TrainConfig(poses=True, size="fixed")
    assert adapted(fixed, scene_of(24)) is fixed


@pytest.mark.parametrize(("below", "photos", "dropout"), [(17, 24, 0.1), (0, 8, 0.0)])
def test_with_enough_photos_the_size_is_searched(below: int, photos: int, dropout: float) -> None:
    config = TrainConfig(few=FewViewsConfig(below=below))
    assert adapted(config, scene_of(photos)) is config
    found = adapted(config, scene_of(photos - 1))
    assert (found.size, found.max_gaussians, found.dropout) == ("fixed", 3000, dropout)


@pytest.mark.parametrize(
    ("given", "most", "dropout"),
    [
        ({"max_gaussians": 500}, 500, 0.2),
        ({"max_gaussians": 5000}, 4000, 0.2),
        ({"max_gaussians": 5000, "size": "fixed"}, 5000, 0.2),
        ({"dropout": 0.5}, 4000, 0.5),
    ],
)
def test_what_is_given_is_kept(given: dict[str, Any], most: int, dropout: float) -> None:
    """A number of Gaussians is a limit, and without a search the number itself."""
    config = TrainConfig(**given)
    found = adapted(config, scene_of(16))
    assert found == replace(config, size="fixed", max_gaussians=most, dropout=dropout)


def test_a_random_start_counts_as_points() -> None:
    """Also if it is chosen here; a fixed size without a limit has none afterwards."""
    scene = scene_of(16, points=0)
    found = adapted(TrainConfig(), scene)
    assert (found.init.random_points, found.max_gaussians) == (RANDOM_START, 4 * RANDOM_START)
    given = adapted(TrainConfig(init=InitConfig(random_points=100)), scene)
    assert (given.init.random_points, given.max_gaussians) == (100, 800)
    fixed = adapted(TrainConfig(size="fixed", strategy="adc"), scene)
    assert (fixed.init.random_points, fixed.max_gaussians, fixed.dropout) == (None, None, 0.2)
