"""No Gaussian surrounds a viewpoint."""

from dataclasses import replace

import numpy as np
import pytest
from small_run import with_strategy

from clsplat import reference
from clsplat.camera import Camera
from clsplat.config import ErrorConfig
from clsplat.constants import ALPHA_MIN
from clsplat.dataset.near_planes import with_near_planes
from clsplat.device import Device
from clsplat.gaussians import Gaussians, logit
from clsplat.scene import Scene
from clsplat.training.camera_room import LEAST, room_factors, steepest_slope, viewpoints
from clsplat.training.session import Training
from clsplat.training.state import initial_state


def gaussians_of(means: list[list[float]], scales: list[list[float]], opacity: float = 0.9) -> Gaussians:
    n, rng = len(means), np.random.default_rng(0)
    return Gaussians(
        np.array(means),
        np.log(scales),
        rng.normal(size=(n, 4)),
        np.full(n, logit(np.array(opacity))),
        np.zeros((n, 1, 3)),
    )


def test_a_splat_beside_a_viewpoint_does_not_reach_the_image() -> None:
    """By the projection of cameras at the viewpoint that look across the direction to the Gaussian."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(200, 3))
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(2, 9, (200, 1))
    found = gaussians_of(means.tolist(), np.exp(rng.normal(0, 1, (200, 3))).tolist())
    slope = steepest_slope([camera_at(0, 0.1)])
    assert slope == pytest.approx(1.3 * np.hypot(32 / 50, 24 / 50))
    factors = room_factors(found, np.zeros((1, 3)), slope)
    assert 50 < (factors < 1).sum() < 200 and (factors >= LEAST).all() and (factors <= 1).all()
    reached = {True: 0, False: 0}
    for row in range(200):
        across = np.cross(means[row], rng.normal(size=3))
        camera = Camera.look_at((0, 0, 0), across + 0.01 * means[row], means[row], 50, 64, 48)
        for shrunk in (True, False):
            one = found.take(np.array([row]))
            one.log_scales[:] += np.log(factors[row]) if shrunk else 0
            splats = reference.project_fwd(one, replace(camera, near=1e-6), 0)
            beside = np.abs(splats.means2d[0] - (32, 24)) - splats.extents[0]
            reached[shrunk] += bool(splats.extents[0, 0] > 0 and (beside < (32, 24)).all())
    assert reached[True] == 0 < reached[False]


def test_a_gaussian_at_a_viewpoint_keeps_a_size() -> None:
    found = gaussians_of([[1, 2, 3]], [[5, 6, 7]])
    assert room_factors(found, np.array([[1.0, 2, 3]]), 1.0) == LEAST
    assert (
        room_factors(gaussians_of([[1, 2, 3]], [[5, 6, 7]], 0.5 * ALPHA_MIN), np.array([[1.0, 2, 3]]), 1.0) == 1
    ).all()


def test_each_gaussian_makes_room_for_the_viewpoint_that_is_nearest_to_it_in_its_extents() -> None:
    """Viewpoints that are too far away to matter are not looked at; none that matters is left out."""
    rng = np.random.default_rng(2)
    found = gaussians_of(rng.uniform(0, 40, (300, 3)).tolist(), np.exp(rng.normal(-0.5, 1, (300, 3))).tolist())
    positions = rng.uniform(0, 40, (150, 3))
    each = [room_factors(found, position[None], 0.7) for position in positions]
    factors = room_factors(found, positions, 0.7)
    np.testing.assert_array_equal(factors, np.min(each, axis=0))
    assert 50 < (factors < 1).sum() < 250


def camera_at(x: float, near: float | None) -> Camera:
    return replace(Camera.look_at((x, 0, 0), (x, 0, 9), (0, 1, 0), 50, 64, 48), near=near)


def test_viewpoints_are_between_neighbours_in_free_space() -> None:
    # The nearest points are at depths of 2, 2 and 0.2.
    cameras = [camera_at(0, 0.6), camera_at(1, 0.6), camera_at(1, 0.6), camera_at(2, 0.06)]
    found = np.unique(viewpoints(cameras), axis=0)
    np.testing.assert_allclose(found, [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [2, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(viewpoints([camera_at(3, None)]), [[3, 0, 0]])
    # The middle is 1.9 from both, or 2.1.
    assert len(viewpoints([camera_at(0, 0.6), camera_at(3.8, 0.6)])) == 3
    assert len(viewpoints([camera_at(0, 0.6), camera_at(4.2, 0.6)])) == 2


def test_the_slope_is_that_of_the_widest_corner() -> None:
    """1 + FRUSTUM_MARGIN is 1.3."""
    wide, narrow = replace(camera_at(0, 0.1), fy=100), camera_at(0, 0.1)
    assert steepest_slope([replace(narrow, fx=90, fy=90), wide]) == pytest.approx(1.3 * np.hypot(32 / 50, 24 / 100))
    fisheye = replace(narrow, model="fisheye")
    assert steepest_slope([fisheye]) == 1 and steepest_slope([fisheye, wide]) == steepest_slope([wide])


@pytest.mark.parametrize("strategy", ["error", "adc"])
def test_training_leaves_room(strategy: str, scene: Scene, device: Device) -> None:
    """In each round and after the last one; the paper's strategy does not."""
    config = replace(with_strategy(strategy), error=ErrorConfig(every=5))
    training = Training(with_near_planes(scene), config, device, initial_state(scene, config))
    cameras = [view.camera for view in training.scene.train]
    room = viewpoints(cameras), steepest_slope(cameras)

    def left(gaussians: Gaussians) -> bool:
        return bool((room_factors(gaussians, *room) > 0.999).all())

    for iteration in (14, 54):  # a round, and after the last one
        training.state = replace(training.state, iteration=iteration)
        training.state.gaussians.log_scales[:3] = np.log(50.0)
        assert not left(training.state.gaussians)
        assert training.state.strategy.due(iteration) or strategy == "adc"
        training.densify(61)
        training.state.move(None)
        assert left(training.state.gaussians) == (strategy == "error")
